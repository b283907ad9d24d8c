//! The network of all containers, whose interface name the packet filter matches.

use super::docker::{Docker, SHORT_TIMEOUT};
use super::start_error::StartError;

/// The option by which containers in a network can't reach each other.
const ALONE: &str = "com.docker.network.bridge.enable_icc=false";

/// Creates the network of this name, which is also that of its interface, unless it exists.
///
/// # Errors
/// When Docker fails.
pub async fn join(docker: &Docker, name: &str) -> Result<(), StartError> {
    if docker.run(&["network", "inspect", name], SHORT_TIMEOUT).await.is_ok() {
        return Ok(());
    }
    // One network for all, because Docker's address pools allow only some thirty.
    let interface = format!("com.docker.network.bridge.name={name}");
    let create = ["network", "create", "--driver", "bridge", "--opt", &interface, "--opt", ALONE, name];
    let created = docker.run(&create, SHORT_TIMEOUT).await;
    match created {
        // Another server, or another client of this one, may have created it first.
        Err(error) if docker.run(&["network", "inspect", name], SHORT_TIMEOUT).await.is_err() => Err(error.into()),
        _ => Ok(()),
    }
}
