//! The mounts of a sandbox, and what they hide of the server.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::simulation::config::SimulationConfig;

/// A path at which a sandbox shows something other than the system.
#[derive(Debug, Clone)]
pub struct Mount {
    /// The absolute path.
    pub at: PathBuf,
    /// bubblewrap's option for it.
    option: &'static str,
    /// What is mounted there; `None` if that is an empty directory.
    pub source: Option<PathBuf>,
}

/// The directory with the configuration of this server's package.
const ETC: &str = "/etc/webots-fleet";

impl Mount {
    /// An empty directory.
    pub fn empty(at: impl Into<PathBuf>) -> Self {
        Self {
            at: at.into(),
            option: "--tmpfs",
            source: None,
        }
    }

    /// The same path, read-only, if it is there.
    pub fn read_only(at: impl Into<PathBuf>) -> Self {
        let at = at.into();
        Self {
            option: "--ro-bind-try",
            source: Some(at.clone()),
            at,
        }
    }

    /// A file from another path, read-only.
    pub fn file(at: PathBuf, source: PathBuf) -> Self {
        Self {
            at,
            option: "--ro-bind",
            source: Some(source),
        }
    }

    /// What is at `source`, which may be another path, read-write.
    pub fn writable(at: PathBuf, source: &Path) -> Self {
        Self {
            at,
            option: "--bind",
            source: Some(source.to_owned()),
        }
    }

    /// The arguments of bubblewrap for this mount.
    pub fn into_arguments(self) -> impl Iterator<Item = OsString> {
        let paths = self.source.into_iter().chain([self.at]);
        std::iter::once(self.option.into()).chain(paths.map(Into::into))
    }
}

/// The mounts that hide what only the server may read: its log, its cache with all simulations, its configuration and
/// other secrets.
pub fn hidden(config: &SimulationConfig) -> Vec<Mount> {
    let folders = [&config.log_dir.0, &config.cache_dir.0]
        .into_iter()
        .filter_map(|folder| folder.canonicalize().ok());
    let mut hidden: Vec<Mount> = folders.chain([ETC.into()]).map(Mount::empty).collect();
    for file in config.secret_files() {
        let Some(real) = file.canonicalize().ok().filter(|file| file.is_file()) else {
            continue;
        };
        // The other configurations are nearby: those of the session server are in a directory beside this one.
        let beside = ["session", "simulation"].map(|name| real.parent().unwrap_or(&real).with_file_name(name));
        if beside.iter().any(|one| real.parent() == Some(one)) {
            hidden.extend(beside.map(Mount::empty));
        }
        hidden.push(Mount::file(real, "/dev/null".into()));
    }
    hidden
}
