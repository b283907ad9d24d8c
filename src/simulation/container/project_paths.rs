//! The paths of the parts of a project.

use std::path::{Path, PathBuf};

use super::build_plan;
use super::start_error::StartError;
use super::webots_yml::{ProjectKind, WebotsYml};
use crate::shared::text::one_line;
use crate::simulation::checkout::Project;

/// The paths of the parts of a project.
#[derive(Debug)]
pub struct ProjectPaths {
    /// Its world, in its directory.
    pub world: String,
    /// Its directory.
    pub project: PathBuf,
    /// The directory that an editor shows.
    pub edited: PathBuf,
}

impl ProjectPaths {
    /// Finds the parts. Makes the participant of a competition an external controller.
    ///
    /// # Errors
    /// When one does not exist or can't be mounted, as text for the client.
    pub fn of(yml: &WebotsYml, project: &Project) -> Result<Self, StartError> {
        let root = project.folder.canonicalize().map_err(|error| error.to_string())?;
        let world = world_in(&root, project)?;
        let edited = match yml.kind {
            ProjectKind::Default => root.clone(),
            ProjectKind::Editor => build_plan::inside(&root, &yml.folder_in_project())?,
            ProjectKind::Competition => {
                build_plan::open_participant(&root.join(&world))?;
                participant_folder(project)
            }
        };
        Ok(Self { world, project: mountable(root)?, edited: mountable(edited)? })
    }
}

/// The directory of a competition's participant. It is not in the project, where a world's program could replace it by
/// a symlink before the controller is restarted.
pub fn participant_folder(project: &Project) -> PathBuf {
    project.instance.path().join("edited")
}

/// The world's path in its project's directory.
///
/// # Errors
/// When it does not exist, as text for the client.
fn world_in(root: &Path, project: &Project) -> Result<String, String> {
    let name = project.world.path.file_name().unwrap_or_default().to_string_lossy();
    let path = root.join("worlds").join(&*name).canonicalize().ok().filter(|path| path.is_file());
    let path = path.ok_or_else(|| format!("The image of this project has no worlds/{name}"))?;
    let inside = path.strip_prefix(root).ok().and_then(Path::to_str).map(str::to_owned);
    inside.ok_or_else(|| {
        "The world is behind a link that leads out of its project, which containers don't have".to_owned()
    })
}

/// Checks that compose can mount a directory: `:` would end its path, and a line break its variable.
///
/// # Errors
/// When not, as text for the client.
fn mountable(folder: PathBuf) -> Result<PathBuf, String> {
    let is_plain = |name: &str| !name.contains(|letter: char| letter == ':' || letter.is_control());
    if folder.to_str().is_some_and(is_plain) {
        return Ok(folder);
    }
    let name = one_line(&folder.file_name().unwrap_or_default().to_string_lossy());
    Err(format!("The path of the folder {name} of this project has a ':' or a line break, which containers can't have"))
}
