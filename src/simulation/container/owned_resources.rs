//! What a server has in Docker: the containers of its simulations. There are no networks and no named volumes of theirs:
//! templates that have some are refused.
//!
//! The names of its compose projects, which those of their containers begin with, have a common prefix, so that the resources
//! of a crashed server are found again.

use std::path::Path;
use std::time::Duration;

use sha2::{Digest, Sha256};

use super::docker::{self, Docker, DockerError, SHORT_TIMEOUT};

/// The owner of compose projects and images: a server, or one run of it. Their names have a common prefix: that of the owner
/// is 12 hexadecimal digits; of a run also `-` and 8 more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResourceOwner(pub String);

/// How long each command of a sweep may take.
const SWEEP_TIMEOUT: Duration = Duration::from_secs(20);
/// How containers are removed, whatever they do.
const REMOVE: [&str; 3] = ["rm", "--force", "--volumes"];

impl ResourceOwner {
    /// The server with this cache directory, which only one server uses.
    pub fn of(cache: &Path) -> Self {
        let cache = cache.canonicalize().unwrap_or_else(|_| cache.to_owned());
        let mut name = digest(cache.as_os_str().as_encoded_bytes());
        name.truncate(12);
        Self(name)
    }

    /// One run of this server: resources of the next run have another owner.
    pub fn run(&self) -> Self {
        Self(format!("{}-{:08x}", self.0, rand::random::<u32>()))
    }

    /// A new name for the compose project of a simulation on this port.
    pub fn project(&self, port: u16) -> String {
        format!("{}{port}-{:08x}", self.prefix(), rand::random::<u32>())
    }

    /// The port of the simulation with this container; `None` if it has another owner.
    pub fn port_of(&self, container: &str) -> Option<u16> {
        container.strip_prefix(&self.prefix())?.split('-').next()?.parse().ok()
    }

    fn prefix(&self) -> String {
        format!("webots-fleet-{}-", self.0)
    }
}

/// The SHA-256 of a text, in hexadecimal digits.
pub fn digest(text: &[u8]) -> String {
    let digest = Sha256::digest(text);
    digest.iter().fold(String::new(), |text, byte| format!("{text}{byte:02x}"))
}

/// Removes containers.
///
/// # Errors
/// When Docker fails; then some may remain.
pub async fn remove(docker: &Docker, containers: &[String]) -> Result<(), DockerError> {
    let words: Vec<&str> = REMOVE.into_iter().chain(containers.iter().map(String::as_str)).collect();
    match docker.run(&words, SHORT_TIMEOUT).await {
        // Another process may remove it.
        Err(DockerError::Failed { message, .. })
            if message.contains("o such container") || message.contains("already in progress") =>
        {
            Ok(())
        }
        done => done.map(drop),
    }
}

/// Removes the containers of an owner, except those in use. Returns the names of those that it has removed. Blocks.
///
/// # Errors
/// When Docker fails; then some may remain.
pub fn sweep(owner: &ResourceOwner, is_used: impl Fn(&str) -> bool) -> Result<Vec<String>, DockerError> {
    let list =
        docker::blocking(&["ps", "--all", "--filter", "name=webots-fleet-", "--format", "{{.Names}}"], SWEEP_TIMEOUT)?;
    let names: Vec<&str> = list.lines().filter(|name| name.starts_with(&owner.prefix()) && !is_used(name)).collect();
    if !names.is_empty() {
        docker::blocking(&[&REMOVE, names.as_slice()].concat(), SWEEP_TIMEOUT)?;
    }
    Ok(names.into_iter().map(str::to_owned).collect())
}

/// Removes all containers of an owner: for a process that watches over the server's end. What is left is removed by the next
/// start. Blocks.
pub fn sweep_all(owner: &ResourceOwner) {
    sweep(owner, |_| false).ok();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_of_projects_tell_whose_they_are_and_suit_compose() {
        let (ours, theirs) =
            (ResourceOwner::of(Path::new("/var/cache/a")), ResourceOwner::of(Path::new("/var/cache/b")));
        let name = ours.project(2001);
        assert!(name.starts_with(&ours.prefix()) && !name.starts_with(&theirs.prefix()), "{name}");
        assert!(name.chars().all(|letter| letter.is_ascii_lowercase() || letter.is_ascii_digit() || letter == '-'));
        assert_ne!(name, ours.project(2001));
        assert_eq!((ours.port_of(&name), theirs.port_of(&name)), (Some(2001), None));
    }
}
