//! Where the parts of a project are.

use std::path::PathBuf;

use super::recipe;
use super::webots_yml::Kind;
use crate::simulation::checkout::Project;

/// The world's path in its project's folder.
///
/// # Errors
/// When it is not there, in words for the client.
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

/// The folder of a competition's participant. It is not in the project, where a world's program could put a link in its
/// place before the controller is started anew.
#[must_use]
pub fn edited_in(project: &Project) -> PathBuf {
    project.instance.path().join("edited")
}

/// The folder that an editor shows.
///
/// # Errors
/// When it is not there, in words for the client.
pub fn edited_folder(kind: &Kind, project: &Project) -> Result<Option<PathBuf>, String> {
    match kind {
        Kind::Default => Ok(None),
        Kind::Competition { .. } => Ok(Some(edited_in(project))),
        Kind::Editor { .. } => {
            let folder = kind.folder_in_project().unwrap_or_default();
            recipe::inside(project.folder(), &folder.to_string_lossy()).map(Some)
        }
    }
}

/// The same as the project names it.
#[must_use]
pub fn volume_of(kind: &Kind) -> Option<&str> {
    match kind {
        Kind::Default => None,
        Kind::Editor { folder } | Kind::Competition { folder } => Some(folder),
    }
}
