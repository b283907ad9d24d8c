//! What a sandbox shows at which place, and what it hides of the server.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::simulation::config::SimulationConfig;

/// A file or folder of which a sandbox shows something else than the system has there.
#[derive(Debug, Clone)]
pub struct Place {
    /// Where.
    pub at: PathBuf,
    /// What is shown there.
    pub content: Content,
}

/// What a sandbox shows at a place.
#[derive(Debug, Clone)]
pub enum Content {
    /// An empty folder.
    Empty,
    /// An empty file.
    EmptyFile,
    /// What is there, only to be read.
    Readable,
    /// What is at another path, to be read and written.
    Writable(PathBuf),
}

/// The administrator's folder, in which a package of this server has its configuration.
const ETC: &str = "/etc/webots-fleet";
/// Folders of the system, of which programs need whatever is there.
const SYSTEM: [&str; 6] = ["/usr", "/lib", "/lib64", "/bin", "/sbin", "/sys"];

impl Place {
    /// Shows this at a path.
    pub fn new(at: &str, content: Content) -> Self {
        Self { at: at.into(), content }
    }

    /// Shows an empty folder.
    pub fn empty(at: PathBuf) -> Self {
        Self { at, content: Content::Empty }
    }

    /// The words by which bubblewrap does so.
    pub fn into_arguments(self) -> Vec<OsString> {
        match self.content {
            Content::Empty => vec!["--tmpfs".into(), self.at.into()],
            Content::EmptyFile => vec!["--ro-bind".into(), "/dev/null".into(), self.at.into()],
            Content::Readable => vec!["--ro-bind-try".into(), self.at.clone().into(), self.at.into()],
            Content::Writable(content) => vec!["--bind".into(), content.into(), self.at.into()],
        }
    }
}

/// What only the server may see: its log, its cache with all simulations, its configuration and other secrets.
pub fn hidden(config: &SimulationConfig, homes: &[PathBuf]) -> Vec<Place> {
    let folders = [&config.log_dir.0, &config.cache_dir.0].into_iter().filter_map(|folder| folder.canonicalize().ok());
    let folders = folders.chain(std::iter::once(ETC.into()));
    let mut hidden: Vec<Place> = folders.map(Place::empty).collect();
    for file in config.secret_files() {
        let Ok(real) = file.canonicalize() else { continue };
        // A file that takes the place of another one is seen again, unless its folder is hidden.
        let named = file.parent().and_then(|folder| folder.canonicalize().ok());
        let folders = named.into_iter().chain(real.parent().map(Path::to_owned));
        hidden.extend(folders.filter(|at| may_be_hidden(at, config, homes)).map(Place::empty));
        // The other configurations are beside it: those of the session server are in a folder beside this one.
        let beside = ["session", "simulation"].map(|name| real.parent().unwrap_or(&real).with_file_name(name));
        if beside.iter().any(|one| real.parent() == Some(one)) {
            hidden.extend(beside.map(Place::empty));
        }
        hidden.push(Place { at: real, content: Content::EmptyFile });
    }
    hidden
}

/// Whether a folder with a secret of the server holds nothing that programs need, as far as that can be told.
fn may_be_hidden(folder: &Path, config: &SimulationConfig, homes: &[PathBuf]) -> bool {
    let depth = folder.components().count();
    let is_of_system =
        depth < 3 || depth == 3 && folder.starts_with("/var") || SYSTEM.iter().any(|one| folder.starts_with(one));
    let shown = config.sandbox.readable.iter().chain(&config.sandbox.writable).chain(&config.webots_home);
    let shown = shown.map(|path| path.0.clone()).chain(homes.iter().cloned());
    let is_shown = shown.filter_map(|path| path.canonicalize().ok()).any(|path| path == folder);
    let holds_webots = config.webots.as_ref().and_then(|path| path.0.canonicalize().ok());
    !is_of_system && !is_shown && !holds_webots.is_some_and(|program| program.starts_with(folder))
}
