//! The network of all containers. The packet filter matches the name of its interface, so a network of the same name with
//! another interface would not be filtered: nothing is started in such a network.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT, docker_output};
use crate::shared::domain::{Failure, Reason};

/// What Docker reports about a network.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "PascalCase")]
struct Network {
    driver: String,
    options: Option<BTreeMap<String, String>>,
}

/// The option that names the interface.
const INTERFACE: &str = "com.docker.network.bridge.name";
/// The option by which containers in a network can't reach each other, and its value.
const ALONE: (&str, &str) = ("com.docker.network.bridge.enable_icc", "false");

/// Creates the network unless it exists.
///
/// # Errors
/// When Docker fails, or the network of this name has other options.
pub async fn join(docker: &Docker, name: &str) -> Result<(), Failure> {
    let wrong = |why: String| Failure::new(Reason::ServerFault, why);
    if let Ok(found) = docker.run(&inspect(name), SHORT_TIMEOUT).await {
        return suits(name, &found).map_err(wrong);
    }
    // One network for all, because Docker's address pools allow only some thirty.
    let interface = format!("{INTERFACE}={name}");
    let alone = format!("{}={}", ALONE.0, ALONE.1);
    let create = [
        "network", "create", "--driver", "bridge", "--opt", &interface, "--opt", &alone, name,
    ];
    let Err(error) = docker.run(&create, SHORT_TIMEOUT).await else {
        return Ok(());
    };
    // Of two concurrent creations Docker refuses the second.
    if let Ok(found) = docker.run(&inspect(name), SHORT_TIMEOUT).await {
        return suits(name, &found).map_err(wrong);
    }
    let otherwise = wrong(format!("Docker can't create the network {name}"));
    Err(docker.explain(error, 0, otherwise).await)
}

/// Checks the network of this name, if there is one. Blocks.
///
/// # Errors
/// What is wrong with it, as text for an administrator.
pub fn check(name: &str) -> Result<(), String> {
    match docker_output(&inspect(name), SHORT_TIMEOUT) {
        Ok(found) => suits(name, &found),
        Err(DockerError::Failed { .. }) => Ok(()),
        Err(error) => Err(error.to_string()),
    }
}

fn inspect(name: &str) -> [&str; 5] {
    ["network", "inspect", "--format", "{{json .}}", name]
}

/// Whether a network, as Docker reports it, is one that this server would have created.
fn suits(name: &str, found: &str) -> Result<(), String> {
    let option = |network: &Network, option| network.options.as_ref()?.get(option).cloned();
    let is_ours = serde_json::from_str(found).is_ok_and(|network: Network| {
        network.driver == "bridge"
            && option(&network, INTERFACE).as_deref() == Some(name)
            && option(&network, ALONE.0).as_deref() == Some(ALONE.1)
    });
    if is_ours {
        return Ok(());
    }
    Err(format!(
        "The Docker network {name} on this simulation server has another interface or other options, so that the packet \
         filter does not apply to it. Its administrator has to remove it (docker network rm {name}); this server creates \
         it again"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_network_that_the_packet_filter_matches_is_used() {
        let network = |driver: &str, interface: &str, icc: &str| {
            let options = serde_json::json!({INTERFACE: interface, ALONE.0: icc});
            serde_json::json!({"Name": "a", "Driver": driver, "Options": options}).to_string()
        };
        assert_eq!(suits("a", &network("bridge", "a", "false")), Ok(()));
        for wrong in [
            network("bridge", "b", "false"),
            network("bridge", "a", "true"),
            network("macvlan", "a", "false"),
            r#"{"Driver":"bridge","Options":null}"#.to_owned(),
            String::new(),
        ] {
            assert!(suits("a", &wrong).is_err(), "{wrong}");
        }
    }
}
