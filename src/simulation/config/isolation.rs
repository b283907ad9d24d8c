//! The keys `isolation`, `sandbox` and `environment`: what a world's programs can access.

use std::fmt;
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::config::{ExpandedPath, OneOrMany};

/// Paths that each sandbox mounts itself.
const OF_EACH: [&str; 3] = ["/", "/proc", "/dev"];

/// The key `isolation`: the isolation level of simulations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum IsolationSetting {
    /// As the server's own user, in a process group, without isolation.
    None,
    /// With bubblewrap; the server does not start without it.
    Sandbox,
    /// With bubblewrap if it works, otherwise as with `none`.
    #[default]
    Auto,
    /// With Docker.
    Container,
}

impl fmt::Display for IsolationSetting {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(out)
    }
}

/// The key `sandbox.network`: which network the programs in a sandbox have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SandboxNetwork {
    /// A separate one for each simulation; the server does not start without it.
    Own,
    /// The machine's.
    Shared,
    /// A separate one for each simulation if pasta works, otherwise the machine's.
    #[default]
    Auto,
    /// A separate one for each simulation, without the internet. Clients still reach Webots.
    Closed,
}

impl SandboxNetwork {
    /// Whether the administrator requires a separate network for each simulation.
    pub fn is_demanded(self) -> bool {
        matches!(self, Self::Own | Self::Closed)
    }
}

/// The key `sandbox`: what a sandbox has besides the system and Webots.
#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SandboxFolders {
    /// Files and directories that are readable. Default: none.
    #[serde(with = "OneOrMany::<ExpandedPath>")]
    pub readable: Vec<ExpandedPath>,
    /// Files and directories that are also writable. Default: none.
    #[serde(with = "OneOrMany::<ExpandedPath>")]
    pub writable: Vec<ExpandedPath>,
    /// Which network it has. Default: auto.
    pub network: SandboxNetwork,
}

impl SandboxFolders {
    /// Refuses what would break the sandbox.
    ///
    /// # Errors
    /// When a directory is the root of the system, or one that each sandbox mounts itself.
    pub fn check(&self) -> Result<(), String> {
        for (key, paths) in [
            ("sandbox.readable", &self.readable),
            ("sandbox.writable", &self.writable),
        ] {
            let is_of_each = |path: &Path| {
                path.canonicalize()
                    .is_ok_and(|path| OF_EACH.map(Path::new).contains(&&*path))
            };
            if let Some(path) = paths.iter().find(|path| is_of_each(&path.0)) {
                let path = path.0.display();
                return Err(format!(
                    "{key}: \"{path}\" can't be shown: each sandbox has its own; allowed is what is inside"
                ));
            }
        }
        Ok(())
    }

    /// The configured paths that do not exist.
    pub fn missing(&self) -> impl Iterator<Item = &Path> {
        self.readable
            .iter()
            .chain(&self.writable)
            .map(|path| path.0.as_path())
            .filter(|path| !path.exists())
    }
}

/// The name of an environment variable, or the prefix of such names, ended by `*`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String")]
pub struct VariableName(String);

impl VariableName {
    /// Whether this is the name of a variable, or a prefix of it.
    pub fn covers(&self, variable: &str) -> bool {
        match self.0.strip_suffix('*') {
            Some(beginning) => variable.starts_with(beginning),
            None => variable == self.0,
        }
    }
}

impl TryFrom<String> for VariableName {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let name = text.strip_suffix('*').unwrap_or(&text);
        if !name.is_empty()
            && name
                .chars()
                .all(|letter| letter.is_ascii_alphanumeric() || letter == '_')
        {
            Ok(Self(text))
        } else {
            Err(format!(
                "{text:?} is no name of an environment variable; allowed is NAME, or BEGINNING*"
            ))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_covers_itself_or_what_begins_with_it() {
        let name = |text: &str| VariableName::try_from(text.to_owned());
        assert!(name("ROS_*").unwrap().covers("ROS_DOMAIN_ID") && !name("ROS_*").unwrap().covers("ROS"));
        assert!(name("LANG").unwrap().covers("LANG") && !name("LANG").unwrap().covers("LANGUAGE"));
        for text in ["", "*", "A=B", "A*B", "A B", "A\0"] {
            assert!(name(text).is_err(), "{text:?}");
        }
    }
}
