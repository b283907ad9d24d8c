//! The network of all containers, whose interface name the packet filter matches.

use super::docker::{Docker, SHORT};
use super::start_error::StartError;

/// Creates the network of this name, which is also that of its interface, unless it exists.
///
/// # Errors
/// When Docker fails.
pub async fn join(docker: &Docker, name: &str) -> Result<(), StartError> {
    if docker.run(&["network", "inspect", name], SHORT).await.is_ok() {
        return Ok(());
    }
    // One network for all, because Docker's address pools allow only some thirty. Containers in it can't reach each
    // other.
    let interface = format!("com.docker.network.bridge.name={name}");
    let options = ["--opt", &interface, "--opt", "com.docker.network.bridge.enable_icc=false"];
    let words: Vec<&str> =
        ["network", "create", "--driver", "bridge"].into_iter().chain(options).chain(std::iter::once(name)).collect();
    let Err(error) = docker.run(&words, SHORT).await else { return Ok(()) };
    // Another server, or another client of this one, may have created it first.
    let is_there = docker.run(&["network", "inspect", name], SHORT).await.is_ok();
    if is_there { Ok(()) } else { Err(error.into()) }
}
