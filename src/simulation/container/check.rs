//! Checks whether this machine can run simulations in containers now.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use super::docker::Docker;
use super::packet_filter;
use super::templates::Templates;
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{ExitReason, Ran, Run, RunError};

/// Timeout of a command that starts a container.
const START: Duration = Duration::from_secs(15);
/// Timeout of the daemon's answer.
const ANSWER: Duration = Duration::from_secs(5);
/// The path of Docker's init process in a container. The program is static: it runs in an empty image.
const INIT: &str = "/sbin/docker-init";
/// The empty image, shared by all servers of a machine.
const EMPTY_IMAGE: &str = "webots-fleet/init";
/// An empty archive in the format of tar: two blocks of zeros.
const EMPTY_TAR: [u8; 1024] = [0; 1024];

/// Checks whether simulations can run in containers. Blocks for some seconds at most.
///
/// # Errors
/// What is missing, as text for an administrator.
pub fn check(config: &SimulationConfig) -> Result<String, String> {
    Docker::find(Path::new("/"))?;
    daemon_fault().map_or(Ok(()), Err)?;
    init_fault().map_or(Ok(()), Err)?;
    packet_filter::missing().map_or(Ok(()), Err)?;
    Ok(format!("it answers; worlds run in {}, or the image of their project's Dockerfile", config.container.image))
}

/// Checks the administrator's templates.
///
/// # Errors
/// The problems with them, as text for an administrator.
pub fn check_templates(config: &SimulationConfig) -> Result<String, String> {
    let faults = Templates::of(&config.container).faults();
    let found = match &config.container.templates {
        Some(folder) => format!("those in {}, else those of this server", folder.0.display()),
        None => "those of this server".to_owned(),
    };
    if faults.is_empty() { Ok(found) } else { Err(faults.join("; ")) }
}

/// Why the daemon can't be used now, as text for clients and administrators. Blocks for five seconds at most.
#[must_use]
pub fn daemon_fault() -> Option<String> {
    let why = failure(ANSWER, &["version", "--format", "{{.Server.Version}}"])?;
    Some(format!("Docker does not answer on this simulation server: {why}"))
}

/// The directory in which Docker keeps images and containers; `None` if it does not run on this machine. Cached after
/// the first answer; blocks for five seconds at most.
#[must_use]
pub fn data_folder() -> Option<PathBuf> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    if std::env::var("DOCKER_HOST").is_ok_and(|host| !host.starts_with("unix:")) {
        return None;
    }
    if FOLDER.get().is_none() {
        let ran = docker(ANSWER, &["info", "--format", "{{.DockerRootDir}}"]).blocking(drop).ok()?;
        let told = String::from_utf8(ran.answer).ok()?;
        let folder = told.lines().last().map(Path::new).filter(|folder| folder.is_absolute() && folder.exists())?;
        // A concurrent check may have set it.
        FOLDER.set(folder.to_owned()).ok();
    }
    FOLDER.get().cloned()
}

/// Why containers can't have an init process, as text for clients and administrators; `None` if they can.
///
/// Without one, `xvfb-run` of the images is process 1, to which Xvfb sends no signal, so that it waits forever. `docker
/// info` does not show it: the version of Debian's docker-init is empty there. So this runs it in a container. Blocks
/// for a second, for 45 at most.
#[must_use]
pub fn init_fault() -> Option<String> {
    let import = || {
        let tar = tempfile::NamedTempFile::new().and_then(|tar| std::fs::write(tar.path(), EMPTY_TAR).map(|()| tar));
        match tar {
            Ok(tar) => failure(START, &["import", &tar.path().to_string_lossy(), EMPTY_IMAGE]),
            Err(error) => Some(error.to_string()),
        }
    };
    let is_missing = failure(START, &["image", "inspect", EMPTY_IMAGE]);
    let why = is_missing
        .and_then(|_| import())
        .or_else(|| failure(START, &["run", "--rm", "--init", "--network", "none", EMPTY_IMAGE, INIT, "--version"]));
    Some(format!(
        "Docker of this simulation server can't give containers an init process (docker run --init): {}. Its administrator \
         can install docker-init: on Debian and Ubuntu the packages docker.io and tini have it, or docker-ce",
        why?
    ))
}

/// Docker with these arguments and this timeout.
fn docker(limit: Duration, arguments: &[&str]) -> Run {
    Run::new(std::iter::once("docker").chain(arguments.iter().copied()), Path::new("/"), limit)
}

/// Runs docker with a timeout. Returns the line with the reason if it fails.
fn failure(limit: Duration, arguments: &[&str]) -> Option<String> {
    let mut said: Vec<String> = Vec::new();
    match docker(limit, arguments).blocking(|line| said.push(line)) {
        Ok(Ran { ending: ExitReason::Code(0), .. }) => return None,
        Ok(_) => {}
        Err(RunError::Slow(_)) => said.clear(),
        Err(error) => return Some(format!("docker {error}")),
    }
    let why = said.iter().find(|line| line.contains("rror")).or_else(|| said.last());
    Some(why.cloned().unwrap_or_else(|| format!("it gives no answer within {} seconds", limit.as_secs())))
}
