//! The keys `isolation`, `sandbox` and `environment`: what a world's programs may see.

use std::path::{Path, PathBuf};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::shared::config::{ExpandedPath, InvalidValue, one_or_many};

/// What each sandbox has by itself.
const OF_EACH: [&str; 2] = ["/proc", "/dev"];
/// What may stand in the key `sandbox`.
const ALLOWED: &str = "allowed are files and folders besides those of the server";

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
    /// Refuses the level that is not there yet. `docker` is the original's key for it.
    ///
    /// # Errors
    /// When containers are asked for.
    pub fn check(self, docker: bool) -> Result<(), InvalidValue> {
        let (key, problem) = if docker {
            let problem = "true is not supported; allowed is false. Worlds would run without the container that was asked \
                           for";
            ("docker", problem)
        } else if self == Self::Container {
            ("isolation", "\"container\" is not supported yet; allowed are \"auto\", \"sandbox\" and \"none\"")
        } else {
            return Ok(());
        };
        Err(InvalidValue { key, problem: problem.to_owned() })
    }
}

/// Reads the key `isolation`.
///
/// # Errors
/// When the value is no level.
pub fn level<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Isolation, D::Error> {
    let value = serde_json::Value::deserialize(deserializer)?;
    if !value.is_string() {
        let allowed = "\"auto\", \"sandbox\", \"none\" and \"container\"";
        return Err(D::Error::custom(format!("{value} is no level; allowed are {allowed}")));
    }
    Isolation::deserialize(value).map_err(D::Error::custom)
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
    /// Refuses what would take the sandbox apart. `own` is what only the server may change.
    ///
    /// # Errors
    /// When a folder is all of the system, or what is the server's own can be changed through it.
    pub fn check<'own>(&self, own: impl Iterator<Item = &'own Path>) -> Result<(), InvalidValue> {
        let own: Vec<PathBuf> = own.filter(|path| !path.as_os_str().is_empty()).map(real).collect();
        let keys = [("sandbox.readable", &self.readable, false), ("sandbox.writable", &self.writable, true)];
        for (key, paths, is_writable) in keys {
            for path in paths {
                let (shown, at) = (path.0.display(), real(&path.0));
                if at.parent().is_none() || OF_EACH.iter().any(|one| at.starts_with(one)) {
                    let problem =
                        format!("\"{shown}\" can't be taken from the system: a sandbox has one of its own, {ALLOWED}");
                    return Err(InvalidValue { key, problem });
                }
                if let Some(inside) = own.iter().find(|own| is_writable && own.starts_with(&at)) {
                    let problem =
                        format!("\"{shown}\" holds {}, which only the server may change; {ALLOWED}", inside.display());
                    return Err(InvalidValue { key, problem });
                }
            }
        }
        Ok(())
    }

    /// What is named, but not there.
    pub fn missing(&self) -> impl Iterator<Item = &Path> {
        self.readable.iter().chain(&self.writable).map(|path| path.0.as_path()).filter(|path| !path.exists())
    }
}

/// A path without links, as far as it is there.
fn real(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let there =
        absolute.ancestors().find_map(|part| Some((part.canonicalize().ok()?, absolute.strip_prefix(part).ok()?)));
    there.map_or_else(
        || absolute.clone(),
        |(real, rest)| if rest.as_os_str().is_empty() { real } else { real.join(rest) },
    )
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
