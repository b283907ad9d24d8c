//! A project that was checked out for one client.

use std::path::PathBuf;
use std::sync::Arc;

use super::revision::Revision;
use super::world_file::WorldFile;
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// A client's checked-out project, removed on drop.
#[derive(Debug)]
pub struct Project {
    /// The world to open.
    pub world: WorldFile,
    /// What it takes of the disk, in bytes.
    pub size: u64,
    /// A warning for the client.
    pub warning: Option<String>,
    /// The URL that it was checked out from.
    pub(super) url: ProjectUrl,
    pub(super) revision: Revision,
    /// The project's directory, with `worlds` and `controllers` inside.
    pub folder: PathBuf,
    /// The instance directory; removed with the project.
    pub instance: Arc<InstanceDir>,
}

impl Project {
    /// What tells this project from others: its repository, its commit, and its folder there.
    pub fn identity(&self) -> String {
        format!("{} {} {}", self.url.repository(), self.revision.commit, self.revision.folder)
    }
}
