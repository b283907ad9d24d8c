//! The paths of the parts of a project.

use std::path::PathBuf;

use super::build_plan;
use super::webots_yml::ProjectKind;
use crate::shared::text::one_line;
use crate::simulation::checkout::Project;

/// The world's path in its project's directory.
///
/// # Errors
/// When it does not exist, as text for the client.
pub fn world_in(project: &Project) -> Result<String, String> {
    let outside = || "The world is behind a link that leads out of its project, which containers don't have".to_owned();
    let root = project.folder().canonicalize().map_err(|error| error.to_string())?;
    let name = project.world.path.file_name().unwrap_or_default();
    let path = root.join("worlds").join(name);
    let path = path
        .canonicalize()
        .map_err(|_| format!("The image of this project has no worlds/{}", name.to_string_lossy()))?;
    if !path.is_file() {
        return Err(format!("worlds/{} of this project is no file in its image", name.to_string_lossy()));
    }
    let inside = path.strip_prefix(&root).map_err(|_| outside())?;
    inside.to_str().map(str::to_owned).ok_or_else(|| "The world's name is no text".to_owned())
}

/// The directory of the project, as a mount for containers.
///
/// # Errors
/// When it can't be mounted, as text for the client.
pub fn project_folder(project: &Project) -> Result<PathBuf, String> {
    project.folder().canonicalize().map_err(|error| error.to_string()).and_then(mountable)
}

/// The directory of a competition's participant. It is not in the project, where a world's program could replace it by
/// a symlink before the controller is restarted.
#[must_use]
pub fn participant_folder(project: &Project) -> PathBuf {
    project.instance.path().join("edited")
}

/// The directory that an editor shows.
///
/// # Errors
/// When it does not exist, as text for the client.
pub fn edited_folder(kind: &ProjectKind, project: &Project) -> Result<Option<PathBuf>, String> {
    match kind {
        ProjectKind::Default => Ok(None),
        ProjectKind::Competition { .. } => Ok(Some(participant_folder(project))),
        ProjectKind::Editor { .. } => {
            let folder = kind.folder_in_project().unwrap_or_default();
            build_plan::inside(project.folder(), &folder.to_string_lossy()).and_then(mountable).map(Some)
        }
    }
}

/// The same directory, as the project names it.
#[must_use]
pub fn volume_of(kind: &ProjectKind) -> Option<&str> {
    match kind {
        ProjectKind::Default => None,
        ProjectKind::Editor { folder } | ProjectKind::Competition { folder } => Some(folder),
    }
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
