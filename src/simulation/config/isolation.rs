//! The keys `isolation`, `sandbox` and `environment`: what a world's programs can access.

use std::path::{Path, PathBuf};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::shared::config::{ExpandedPath, InvalidValueError, one_or_many};

/// Paths that each sandbox mounts itself.
const OF_EACH: [&str; 3] = ["/", "/proc", "/dev"];

/// The key `isolation`: the isolation level of simulations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
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

impl IsolationSetting {
    /// The level that both keys request: `docker` is the original's key for containers.
    ///
    /// # Errors
    /// When they contradict each other.
    pub fn with_docker(self, docker: bool) -> Result<Self, InvalidValueError> {
        match self {
            Self::Auto if docker => Ok(Self::Container),
            Self::None | Self::Sandbox if docker => {
                let problem = "true asks for containers, but isolation for another level; remove one of them";
                Err(InvalidValueError { key: "docker", problem: problem.to_owned() })
            }
            level => Ok(level),
        }
    }
}

/// Reads the key `isolation`.
///
/// # Errors
/// When the value is not a level.
pub fn level<'de, D: Deserializer<'de>>(deserializer: D) -> Result<IsolationSetting, D::Error> {
    let value = serde_json::Value::deserialize(deserializer)?;
    if !value.is_string() {
        let allowed = "\"auto\", \"sandbox\", \"none\" and \"container\"";
        return Err(D::Error::custom(format!("{value} is no level; allowed are {allowed}")));
    }
    IsolationSetting::deserialize(value).map_err(D::Error::custom)
}

/// The key `sandbox.network`: which network the programs in a sandbox have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SandboxNetwork {
    /// One of each simulation's own, or the server does not start.
    Own,
    /// The machine's.
    Shared,
    /// One of each simulation's own where pasta works, otherwise the machine's.
    #[default]
    Auto,
    /// One of each simulation's own, without the internet. Clients reach Webots all the same.
    Closed,
}

impl SandboxNetwork {
    /// Whether the administrator relies on it.
    pub fn is_demanded(self) -> bool {
        matches!(self, Self::Own | Self::Closed)
    }
}

/// The key `sandbox`: what a sandbox has besides the system and Webots.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SandboxFolders {
    /// Files and directories that are readable. Default: none.
    #[serde(deserialize_with = "one_or_many")]
    pub readable: Vec<ExpandedPath>,
    /// Files and directories that are also writable. Default: none.
    #[serde(deserialize_with = "one_or_many")]
    pub writable: Vec<ExpandedPath>,
    /// Which network it has. Default: auto.
    pub network: SandboxNetwork,
}

impl SandboxFolders {
    /// Refuses what would break the sandbox, and warns of what weakens it: `own` are the paths that only the server
    /// should change.
    ///
    /// # Errors
    /// When a directory is the root of the system, or one that each sandbox mounts itself.
    pub fn check<'own>(&self, own: impl Iterator<Item = &'own Path>) -> Result<Vec<String>, InvalidValueError> {
        for (key, paths) in [("sandbox.readable", &self.readable), ("sandbox.writable", &self.writable)] {
            if let Some(path) = paths.iter().find(|path| OF_EACH.iter().any(|one| real(&path.0) == Path::new(one))) {
                let path = path.0.display();
                let problem = format!("\"{path}\" can't be shown: each sandbox has its own; allowed is what is inside");
                return Err(InvalidValueError { key, problem });
            }
        }
        let writable: Vec<PathBuf> = self.writable.iter().map(|path| real(&path.0)).collect();
        let open = own.filter(|path| !path.as_os_str().is_empty()).map(real);
        let open = open.filter(|path| writable.iter().any(|folder| path.starts_with(folder)));
        let told = |path: PathBuf| format!("sandbox.writable lets worlds replace {}", path.display());
        Ok(open.map(told).collect())
    }

    /// The configured paths that do not exist.
    pub fn missing(&self) -> impl Iterator<Item = &Path> {
        self.readable.iter().chain(&self.writable).map(|path| path.0.as_path()).filter(|path| !path.exists())
    }
}

/// The canonical path, as far as it exists.
fn real(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let there =
        absolute.ancestors().find_map(|part| Some((part.canonicalize().ok()?, absolute.strip_prefix(part).ok()?)));
    there.map_or_else(
        || absolute.clone(),
        |(real, rest)| if rest.as_os_str().is_empty() { real } else { real.join(rest) },
    )
}

/// The name of an environment variable, or the prefix of such names, ended by `*`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
    fn what_is_the_servers_own_is_told_where_worlds_can_write_it() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().canonicalize().unwrap();
        std::os::unix::fs::symlink(&at, at.join("link")).unwrap();
        let own = [at.join("link/a/log"), at.join("b/config.json"), PathBuf::new()];
        let check = |writable: &str, readable: &str| {
            let paths = |path: &str| vec![ExpandedPath(path.into())];
            let folders =
                SandboxFolders { readable: paths(readable), writable: paths(writable), ..SandboxFolders::default() };
            folders.check(own.iter().map(PathBuf::as_path)).map_err(|error| error.key)
        };
        let told = |path: &str| format!("sandbox.writable lets worlds replace {}", at.join(path).display());
        let text = |path: &str| at.join(path).to_str().unwrap().to_owned();
        assert_eq!(check(&text("a"), &text("b")), Ok(vec![told("a/log")]));
        assert_eq!(check(&text("link"), "/dev/shm"), Ok(vec![told("a/log"), told("b/config.json")]));
        assert_eq!(check(&text("c"), "/proc/.."), Err("sandbox.readable"));
        assert_eq!(check("/dev/../proc", "/srv"), Err("sandbox.writable"));
    }

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
