//! The network of all containers, whose interface name the packet filter matches.

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};

/// The option by which containers in a network can't reach each other.
const ALONE: &str = "com.docker.network.bridge.enable_icc=false";

/// Creates the network of this name, which is also that of its interface, unless it exists.
///
/// # Errors
/// When Docker fails.
pub async fn join(docker: &Docker, name: &str) -> Result<(), DockerError> {
    // One network for all, because Docker's address pools allow only some thirty.
    let interface = format!("com.docker.network.bridge.name={name}");
    let create = ["network", "create", "--driver", "bridge", "--opt", &interface, "--opt", ALONE, name];
    match docker.run(&create, SHORT_TIMEOUT).await {
        Err(DockerError::Failed { message, .. }) if message.contains("already exists") => Ok(()),
        // Two that are created at the same time would have the same interface, which Docker refuses.
        Err(DockerError::Failed { message, .. }) if message.contains("have same bridge name") => {
            docker.run(&["network", "inspect", name], SHORT_TIMEOUT).await.map(drop)
        }
        created => created.map(drop),
    }
}
