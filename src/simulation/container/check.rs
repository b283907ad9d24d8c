//! Checks whether this machine can run simulations in containers now.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use super::docker::{self, Docker};
use super::packet_filter;
use super::templates;
use crate::simulation::config::SimulationConfig;

/// Timeout of the daemon's answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// Checks whether simulations can run in containers. Blocks for some seconds at most.
///
/// # Errors
/// What is missing, as text for an administrator.
pub fn check(config: &SimulationConfig) -> Result<String, String> {
    Docker::find(Path::new("/"))?;
    daemon_fault().or_else(packet_filter::missing).map_or(Ok(()), Err)?;
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
