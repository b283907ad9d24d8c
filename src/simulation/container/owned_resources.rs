//! What a server has in Docker: the containers of its simulations, found by the label that compose gives to all that it
//! makes. There are no networks and no named volumes of theirs: templates that have some are refused.
//!
//! The names of its compose projects have a common prefix, so that the resources of a crashed server are found again.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use sha2::{Digest, Sha256};

use super::docker::{self, Docker, DockerError, SHORT_TIMEOUT};

/// The label with which compose marks its projects.
pub const PROJECT: &str = "com.docker.compose.project";

/// Arguments of docker that list all containers of compose: the id and the project of each. A container inherits labels of
/// its image, which a project may have made: a quoted beginning of it is one word on one line.
pub const LIST: [&str; 7] = [
    "ps",
    "--all",
    "--no-trunc",
    "--filter",
    "label=com.docker.compose.project",
    "--format",
    "{{.ID}} {{printf \"%.100q\" (.Label \"com.docker.compose.project\")}}",
];

/// The owner of compose projects and images: a server, or one run of it. Their names have a common prefix.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResourceOwner(String);

/// How long each command of a sweep may take.
const SWEEP_TIMEOUT: Duration = Duration::from_secs(20);
/// How containers are removed, whatever they do.
const REMOVE: [&str; 3] = ["rm", "--force", "--volumes"];

impl ResourceOwner {
    /// The server with this cache directory, which only one server uses.
    #[must_use]
    pub fn of(cache: &Path) -> Self {
        let cache = cache.canonicalize().unwrap_or_else(|_| cache.to_owned());
        let mut name = digest(cache.as_os_str().as_encoded_bytes());
        name.truncate(12);
        Self(name)
    }

    /// One run of this server: resources of the next run have another owner.
    #[must_use]
    pub fn run(&self) -> Self {
        Self(format!("{}-{:08x}", self.0, rand::random::<u32>()))
    }

    /// The owner with this name, from [`Self::name`].
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self(name.to_owned())
    }

    /// Its name: 12 hexadecimal digits; for a run also `-` and 8 more.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.0
    }

    /// A new name for the compose project of a simulation on this port.
    #[must_use]
    pub fn project(&self, port: u16) -> String {
        format!("{}{port}-{:08x}", self.prefix(), rand::random::<u32>())
    }

    /// The port of the simulation with this compose project; `None` if it has another owner.
    #[must_use]
    pub fn port_of(&self, project: &str) -> Option<u16> {
        project.strip_prefix(&self.prefix())?.split('-').next()?.parse().ok()
    }

    fn prefix(&self) -> String {
        format!("webots-fleet-{}-", self.0)
    }

    /// The containers of this owner in what [`LIST`] prints: the id and the project of each.
    pub fn containers<'list>(&self, list: &'list str) -> impl Iterator<Item = (&'list str, &'list str)> {
        let prefix = self.prefix();
        let lines = list.lines().filter_map(|line| line.strip_suffix('"')?.split_once(" \""));
        lines.filter(move |(_, project)| project.starts_with(&prefix))
    }
}

/// The SHA-256 of a text, in hexadecimal digits.
#[must_use]
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

/// Removes the containers of an owner, except those of projects in use. Returns the projects of what it has removed.
/// Blocks.
///
/// # Errors
/// When Docker fails; then some may remain.
pub fn sweep(owner: &ResourceOwner, is_used: impl Fn(&str) -> bool) -> Result<BTreeSet<String>, DockerError> {
    let list = docker::blocking(&LIST, SWEEP_TIMEOUT)?;
    let (ids, projects): (Vec<_>, BTreeSet<_>) =
        owner.containers(&list).filter(|(_, project)| !is_used(project)).unzip();
    if !ids.is_empty() {
        docker::blocking(&[&REMOVE, ids.as_slice()].concat(), SWEEP_TIMEOUT)?;
    }
    Ok(projects.into_iter().map(str::to_owned).collect())
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
