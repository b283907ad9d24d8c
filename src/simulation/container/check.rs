//! Checks whether this machine can run simulations in containers now.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use super::docker::{self, Docker};
use super::packet_filter;
use super::templates;
use crate::simulation::config::SimulationConfig;

/// Timeout of a command that starts a container.
const START_TIMEOUT: Duration = Duration::from_secs(15);
/// Timeout of the daemon's answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// The path of Docker's init process in a container. The program is static: it runs in an empty image.
const INIT: &str = "/sbin/docker-init";
/// The empty image, shared by all servers of a machine.
const EMPTY_IMAGE: &str = "webots-fleet/init";

/// Checks whether simulations can run in containers. Blocks for some seconds at most.
///
/// # Errors
/// What is missing, as text for an administrator.
pub fn check(config: &SimulationConfig) -> Result<String, String> {
    Docker::find(Path::new("/"))?;
    [daemon_fault, init_fault, packet_filter::missing].iter().find_map(|fault| fault()).map_or(Ok(()), Err)?;
    Ok(format!("it answers; worlds run in {}, or the image of their project's Dockerfile", config.container.image))
}

/// Checks the administrator's templates.
///
/// # Errors
/// The problems with them, as text for an administrator.
pub fn check_templates(config: &SimulationConfig) -> Result<String, String> {
    let faults = templates::faults(&config.container);
    let found = match &config.container.templates {
        Some(folder) => format!("those in {}, else those of this server", folder.0.display()),
        None => "those of this server".to_owned(),
    };
    if faults.is_empty() { Ok(found) } else { Err(faults.join("; ")) }
}

/// Why the daemon can't be used now, as text for clients and administrators. Blocks for five seconds at most.
pub fn daemon_fault() -> Option<String> {
    let version = docker::blocking(&["version", "--format", "{{.Server.Version}}"], ANSWER_TIMEOUT);
    version.err().map(|error| error.to_string())
}

/// The directory in which Docker keeps images and containers; `None` if it does not run on this machine. Cached after
/// the first answer; blocks for five seconds at most.
pub fn data_folder() -> Option<PathBuf> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    if std::env::var("DOCKER_HOST").is_ok_and(|host| !host.starts_with("unix:")) {
        return None;
    }
    if FOLDER.get().is_none() {
        let output = docker::blocking(&["info", "--format", "{{.DockerRootDir}}"], ANSWER_TIMEOUT).ok()?;
        let folder = Some(PathBuf::from(output.trim())).filter(|folder| folder.is_absolute() && folder.exists())?;
        // A concurrent check may have set it.
        FOLDER.set(folder).ok();
    }
    FOLDER.get().cloned()
}

/// Why containers can't have an init process, as text for clients and administrators; `None` if they can.
///
/// Without one, `xvfb-run` of the images is process 1, to which Xvfb sends no signal, so that it waits forever. `docker
/// info` does not show it: the version of Debian's docker-init is empty there. So this runs it in a container. Blocks
/// for a second, for 45 at most.
pub fn init_fault() -> Option<String> {
    let run = || {
        if docker::blocking(&["image", "inspect", EMPTY_IMAGE], START_TIMEOUT).is_err() {
            docker::blocking(&["import", "/dev/null", EMPTY_IMAGE], START_TIMEOUT)?;
        }
        let words = ["run", "--rm", "--init", "--network", "none", EMPTY_IMAGE, INIT, "--version"];
        docker::blocking(&words, START_TIMEOUT)
    };
    let why = run().err()?;
    Some(format!(
        "Docker of this simulation server can't give containers an init process (docker run --init): {why}. Its \
         administrator can install docker-init: on Debian and Ubuntu the packages docker.io and tini have it, or docker-ce"
    ))
}
