//! A project that was checked out for one client, and its world.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::revision::Revision;
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// A client's checked-out project, removed on drop.
#[derive(Debug)]
pub struct Project {
    /// The world to open.
    pub world: WorldFile,
    /// Its size, in bytes.
    pub size: u64,
    /// The URL that it was checked out from.
    pub url: ProjectUrl,
    pub(super) revision: Revision,
    /// The project's directory, with `worlds` and `controllers` inside.
    pub folder: PathBuf,
    /// The instance directory; removed with the project.
    pub instance: Arc<InstanceDir>,
}

/// The world of a checkout.
#[derive(Debug)]
pub struct WorldFile {
    /// The canonical path of the file, without symlinks.
    pub path: PathBuf,
    /// The version of Webots that it was made for, such as `R2025a`.
    pub version: String,
}

impl Project {
    /// The URL of its repository.
    pub fn repository(&self) -> String {
        self.url.repository()
    }

    /// Identifies the project by its repository, its commit and its directory.
    pub fn identity(&self) -> String {
        format!(
            "{} {} {}",
            self.url.repository(),
            self.revision.commit,
            self.revision.folder
        )
    }
}

impl WorldFile {
    /// Inspects a world file below the directory `root`. Blocks.
    ///
    /// # Errors
    /// When it is not a world inside of that directory, as text for the client.
    pub fn open(root: &Path, path: &Path) -> Result<Self, String> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let missing = |_| format!("{name} does not exist");
        let root = root.canonicalize().map_err(missing)?;
        let path = path.canonicalize().map_err(missing)?;
        if !path.starts_with(&root) {
            return Err(format!("{name} leads out of its repository"));
        }
        let file = std::fs::File::open(&path).map_err(missing)?;
        let mut line = Vec::new();
        BufReader::new(file.take(200))
            .read_until(b'\n', &mut line)
            .map_err(missing)?;
        let line = String::from_utf8_lossy(&line).trim().to_owned();
        match line.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["#VRML_SIM", version, "utf8", ..] => Ok(Self {
                version: (*version).to_owned(),
                path,
            }),
            _ => Err(format!(
                "{name} is no world file: its first line is {line:?}, not \"#VRML_SIM R2025a utf8\""
            )),
        }
    }
}
