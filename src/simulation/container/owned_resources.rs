//! What a server has in Docker: the containers of its simulations, without networks or named volumes of their own.
//!
//! The name of a container begins with that of its compose project. The names of a server's compose projects have a
//! common prefix, so that the containers of a crashed server are found again.

use std::path::Path;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use sha2::{Digest, Sha256};
use tokio::runtime::Handle;

use super::docker::{DockerError, SHORT_TIMEOUT, docker_output};
use crate::simulation::run_id::RunId;

/// The owner of compose projects and images: a server, or one run of it. Their names contain the owner:
/// 12 hexadecimal digits for a server, and `-` and 8 more for a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResourceOwner(pub String);

/// The name of a compose project. Dropping it removes the project's containers, as soon as Docker can.
#[derive(Debug)]
pub struct ProjectGuard {
    /// The name; unique on this machine.
    pub name: String,
    /// The runtime that removes the containers.
    pub runtime: Handle,
}

/// The arguments that remove containers, running or not.
pub const REMOVE: [&str; 3] = ["rm", "--force", "--volumes"];
/// Number of removals of a project's containers that must succeed, because Docker may still be creating one.
const LOOKS: usize = 3;
/// The pause before the first attempts, and after them the pause between two: Docker may be away for long.
const PAUSE: Duration = Duration::from_secs(2);
const LONG_PAUSE: Duration = Duration::from_secs(15);
/// Number of attempts that have failed after which the long pause applies.
const SHORT_PAUSES: usize = 60;

impl ResourceOwner {
    /// The server with this cache directory, which only one server uses.
    pub fn of(cache: &Path) -> Self {
        let cache = cache.canonicalize().unwrap_or_else(|_| cache.to_owned());
        let mut name = hex::encode(Sha256::digest(cache.as_os_str().as_encoded_bytes()));
        name.truncate(12);
        Self(name)
    }

    fn of_run(&self, run: RunId) -> Self {
        Self(format!("{}-{run}", self.0))
    }

    /// This run of this server: resources of the next run have another owner.
    pub fn run(&self) -> Self {
        self.of_run(RunId::own())
    }

    /// A new name for the compose project of a simulation on this port.
    pub fn project(&self, port: u16) -> String {
        format!("{}{:08x}", self.prefix_of(port), rand::random::<u32>())
    }

    /// The beginning of the names of the compose projects of simulations on this port.
    pub fn prefix_of(&self, port: u16) -> String {
        format!("{}{port}-", self.prefix())
    }

    /// The port of the simulation with this container; `None` if it has another owner.
    pub fn port_of(&self, container: &str) -> Option<u16> {
        container.strip_prefix(&self.prefix())?.split('-').next()?.parse().ok()
    }

    fn prefix(&self) -> String {
        format!("webots-fleet-{}-", self.0)
    }
}

impl ProjectGuard {
    /// Removes the containers now, if Docker can.
    pub async fn remove(self) {
        let name = self.name.clone();
        spawn_blocking(move || sweep(&name).ok()).await.ok();
    }
}

impl Drop for ProjectGuard {
    fn drop(&mut self) {
        let name = std::mem::take(&mut self.name);
        self.runtime.spawn(async move {
            let mut failures = 0;
            let mut looks = 0;
            while looks < LOOKS {
                actix_rt::time::sleep(if failures < SHORT_PAUSES { PAUSE } else { LONG_PAUSE }).await;
                let project = name.clone();
                match spawn_blocking(move || sweep(&project)).await {
                    Ok(Ok(())) => looks += 1,
                    Ok(Err(error)) => {
                        failures += 1;
                        if failures == 1 {
                            log::warn!("Docker can't remove the containers of {name} yet: {error}");
                        }
                    }
                    // The server is ending.
                    Err(_) => return,
                }
            }
            if failures > 0 {
                log::info!("Docker answers again: the containers of {name} are removed");
            }
        });
    }
}

/// Removes all containers of an owner. The next start removes what is left. Blocks.
pub fn sweep_all(owner: &ResourceOwner) {
    sweep_except(owner, &[]);
}

/// Removes all containers of a server, except those of these runs. The next start removes what is left. Blocks.
pub fn sweep_except(server: &ResourceOwner, living: &[RunId]) {
    let kept: Vec<String> = living.iter().map(|run| server.of_run(*run).prefix()).collect();
    let prefix = server.prefix();
    remove(|name| name.starts_with(&prefix) && !kept.iter().any(|kept| name.starts_with(kept))).ok();
}

/// Removes the containers whose names begin like this. Blocks.
fn sweep(prefix: &str) -> Result<(), DockerError> {
    remove(|name| name.starts_with(prefix))
}

fn remove(is_chosen: impl Fn(&str) -> bool) -> Result<(), DockerError> {
    let list = docker_output(
        &[
            "ps",
            "--all",
            "--filter",
            "name=webots-fleet-",
            "--format",
            "{{.Names}}",
        ],
        SHORT_TIMEOUT,
    )?;
    let names: Vec<&str> = list.lines().filter(|name| is_chosen(name)).collect();
    if !names.is_empty() {
        docker_output(&[&REMOVE, names.as_slice()].concat(), SHORT_TIMEOUT)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_of_projects_tell_whose_they_are_and_suit_compose() {
        let ours = ResourceOwner::of(Path::new("/var/cache/a"));
        let theirs = ResourceOwner::of(Path::new("/var/cache/b"));
        let name = ours.project(2001);
        assert!(
            name.starts_with(&ours.prefix()) && !name.starts_with(&theirs.prefix()),
            "{name}"
        );
        assert!(
            name.chars()
                .all(|letter| letter.is_ascii_lowercase() || letter.is_ascii_digit() || letter == '-')
        );
        assert_ne!(name, ours.project(2001));
        assert_eq!((ours.port_of(&name), theirs.port_of(&name)), (Some(2001), None));
    }
}
