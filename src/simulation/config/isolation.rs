//! The keys `isolation`, `sandbox` and `environment`: what a world's programs may see.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::shared::config::{ExpandedPath, InvalidValue, one_or_many};

/// The key `isolation`: at which level simulations are started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Isolation {
    /// As the server's own user, in a process group.
    None,
    /// By bubblewrap, or not at all.
    Sandbox,
    /// By bubblewrap where it works, otherwise as with `none`.
    #[default]
    Auto,
    /// By Docker.
    Container,
}

impl Isolation {
    /// The level that both keys ask for: `docker` is the original's key for containers.
    ///
    /// # Errors
    /// When they contradict each other.
    pub fn with_docker(self, docker: bool) -> Result<Self, InvalidValue> {
        match self {
            Self::Auto if docker => Ok(Self::Container),
            Self::None | Self::Sandbox if docker => {
                let problem = "true asks for containers, but isolation for another level; remove one of them";
                Err(InvalidValue { key: "docker", problem: problem.to_owned() })
            }
            level => Ok(level),
        }
    }
}

/// The key `sandbox`: what a sandbox has besides the system and Webots.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SandboxFolders {
    /// Files and folders that can be read. Default: none.
    #[serde(deserialize_with = "one_or_many")]
    pub readable: Vec<ExpandedPath>,
    /// Files and folders that can also be written. Default: none.
    #[serde(deserialize_with = "one_or_many")]
    pub writable: Vec<ExpandedPath>,
}

impl SandboxFolders {
    /// What is named, but not there.
    pub fn missing(&self) -> impl Iterator<Item = &Path> {
        self.readable.iter().chain(&self.writable).map(|path| path.0.as_path()).filter(|path| !path.exists())
    }
}

/// The name of an environment variable, or with `*` at its end the beginning of such names.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct VariableName(String);

impl VariableName {
    /// Whether this is the name of a variable, or its beginning.
    #[must_use]
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
        if !name.is_empty() && name.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '_') {
            Ok(Self(text))
        } else {
            Err(format!("{text:?} is no name of an environment variable; allowed is NAME, or BEGINNING*"))
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
