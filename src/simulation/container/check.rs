//! Whether this machine can run simulations in containers, now.

use std::path::Path;
use std::process::{Command, Stdio};

use super::docker::Docker;
use super::packet_filter;
use crate::shared::text::one_line;
use crate::simulation::config::SimulationConfig;

/// Looks whether simulations can run in containers. Blocks for some seconds at most.
///
/// # Errors
/// What is missing, in words for an administrator.
pub fn check(config: &SimulationConfig) -> Result<String, String> {
    Docker::find(Path::new("/"))?;
    daemon_fault().map_or(Ok(()), Err)?;
    packet_filter::missing().map_or(Ok(()), Err)?;
    Ok(format!("it answers; worlds run in {}, or the image of their project's Dockerfile", config.container.image))
}

/// Why the daemon can't be used now, in words for clients and administrators. Blocks for five seconds at most.
#[must_use]
pub fn daemon_fault() -> Option<String> {
    let mut command = Command::new("timeout");
    command.args(["5", "docker", "version", "--format", "{{.Server.Version}}"]).stdin(Stdio::null());
    let output = match command.output() {
        Ok(output) if output.status.success() => return None,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => error.to_string(),
    };
    let line = output.lines().last().unwrap_or("it gives no answer within 5 seconds");
    Some(format!("Docker does not answer on this simulation server: {}", one_line(line)))
}
