//! The paths of the parts of a project.

use std::path::{Path, PathBuf};

use super::build_plan;
use super::webots_yml::{ProjectKind, WebotsYml};
use crate::shared::text::one_line;
use crate::simulation::checkout::Project;

/// The world's path in its project's directory.
///
/// # Errors
/// When it does not exist, as text for the client.
pub fn world_in(project: &Project) -> Result<String, String> {
    let name = project.world.path.file_name().unwrap_or_default().to_string_lossy();
    let root = project.folder().canonicalize().map_err(|error| error.to_string())?;
    let path = root.join("worlds").join(&*name).canonicalize().ok().filter(|path| path.is_file());
    let path = path.ok_or_else(|| format!("The image of this project has no worlds/{name}"))?;
    let inside = path.strip_prefix(&root).ok().and_then(Path::to_str).map(str::to_owned);
    inside.ok_or_else(|| {
        "The world is behind a link that leads out of its project, which containers don't have".to_owned()
    })
}

/// The directory of a competition's participant. It is not in the project, where a world's program could replace it by
/// a symlink before the controller is restarted.
#[must_use]
pub fn participant_folder(project: &Project) -> PathBuf {
    project.instance.path().join("edited")
}

/// The directories of the project and of what an editor shows, as mounts for containers.
///
/// # Errors
/// When one does not exist or can't be mounted, as text for the client.
pub fn mounts(yml: &WebotsYml, project: &Project) -> Result<(PathBuf, PathBuf), String> {
    let root = project.folder().canonicalize().map_err(|error| error.to_string())?;
    let edited = match yml.kind {
        ProjectKind::Default => root.clone(),
        ProjectKind::Competition => participant_folder(project),
        ProjectKind::Editor => build_plan::inside(&root, &yml.folder_in_project())?,
    };
    Ok((mountable(root)?, mountable(edited)?))
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
