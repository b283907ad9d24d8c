//! The build plan of a checked-out project: its Dockerfiles, and the files that they need; and the paths of its parts.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;

use super::dockerfile::Dockerfile;
use super::failures::of_project;
use super::webots_yml::{ProjectKind, WebotsYml, text_of};
use crate::shared::domain::Failure;
use crate::shared::text::one_line;
use crate::simulation::checkout::Project;
use crate::simulation::process::own_call_failed;

/// The path of a project in its container, as existing Dockerfiles expect.
pub const PROJECT_PATH: &str = "/usr/local/webots-project";

/// The build plan of a project.
#[derive(Debug)]
pub struct BuildPlan {
    /// What its `webots.yml` requests.
    pub yml: WebotsYml,
    /// The image of Webots.
    pub image: ImageBuild,
    /// The image of the controllers.
    pub controller: Option<ImageBuild>,
}

/// An image to build.
#[derive(Debug)]
pub struct ImageBuild {
    /// The Dockerfile.
    pub dockerfile: Dockerfile,
    /// The directory of the project that it copies from, empty for the whole project; `None` for the image of Webots, which
    /// is the same for all projects.
    pub folder: Option<&'static str>,
    /// Its arguments, such as `MAKE=1`.
    pub arguments: Vec<String>,
}

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

/// Arguments of the Dockerfile of a participant's controller.
const PARTICIPANT: [&str; 2] = ["WEBOTS_CONTROLLER_URL=participant", "DEFAULT_CONTROLLER=participant"];
/// The Dockerfile for a project that has a Makefile, but no Dockerfile.
const DOCKERFILE: &str = include_str!("../../../config/simulation/docker/Dockerfile.default");
/// The Dockerfile for the controllers of a competition if they have none.
const CONTROLLER_DOCKERFILE: &str = include_str!("../../../config/simulation/docker/Dockerfile.controller");
/// The launcher of a participant's controller.
const LAUNCHER: &str = "remote_controller_launcher.py";
const LAUNCHER_TEXT: &str = include_str!("../../../config/simulation/docker/remote_controller_launcher.py");
/// The Dockerfile for a project that has nothing to build.
const NO_DOCKERFILE: &str = "ARG WEBOTS_DEFAULT_IMAGE\nFROM ${WEBOTS_DEFAULT_IMAGE}\n";

impl BuildPlan {
    /// Reads a project, and adds the files that a competition needs. Blocks.
    ///
    /// # Errors
    /// The problem of the project.
    pub fn read(project: &Path, owner: &str) -> Result<Self, String> {
        let yml = WebotsYml::read(project);
        let has_makefile = project.join("Makefile").is_file();
        let dockerfile = text_of(&project.join("Dockerfile"))?.or_else(|| has_makefile.then(|| DOCKERFILE.to_owned()));
        let is_competition = yml.kind == ProjectKind::Competition;
        let controller = is_competition.then(|| competition(project)).transpose()?;
        let build = |text: &str, folder, more: &[&str]| {
            let mut arguments = vec![
                format!("PROJECT_PATH={PROJECT_PATH}"),
                format!("MAKE={}", u8::from(has_makefile)),
            ];
            arguments.extend(more.iter().map(|argument| (*argument).to_owned()));
            Ok::<_, String>(ImageBuild {
                dockerfile: Dockerfile::read(text, owner)?,
                folder,
                arguments,
            })
        };
        let image = match dockerfile {
            Some(text) => build(&text, Some(""), &[])?,
            None => build(NO_DOCKERFILE, None, &[])?,
        };
        let controller = controller
            .map(|text| build(&text, Some("controllers"), &PARTICIPANT))
            .transpose()?;
        Ok(Self { yml, image, controller })
    }
}

impl ProjectPaths {
    /// Finds the parts. Makes the participant of a competition an external controller.
    ///
    /// # Errors
    /// When one does not exist or can't be mounted.
    pub fn of(yml: &WebotsYml, project: &Project) -> Result<Self, Failure> {
        let root = project
            .folder
            .canonicalize()
            .map_err(|error| of_project(error.kind().to_string()))?;
        let world = world_in(&root, project).map_err(of_project)?;
        let edited = match yml.kind {
            ProjectKind::Default => root.clone(),
            ProjectKind::Editor => inside(&root, &yml.folder_in_project()).map_err(of_project)?,
            ProjectKind::Competition => {
                open_participant(&root.join(&world))?;
                participant_folder(project)
            }
        };
        Ok(Self {
            world,
            project: mountable(root).map_err(of_project)?,
            edited: mountable(edited).map_err(of_project)?,
        })
    }
}

/// The Dockerfile of a competition's controllers. Writes the launcher to the directories from which this Dockerfile
/// and the project's can copy it.
fn competition(project: &Path) -> Result<String, String> {
    let controllers = inside(project, Path::new("controllers"))?;
    for folder in [project, &controllers] {
        // The project's own file stays.
        match File::create_new(folder.join(LAUNCHER)).and_then(|mut file| file.write_all(LAUNCHER_TEXT.as_bytes())) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(format!("{LAUNCHER} can't be written: {error}"));
            }
            _ => {}
        }
    }
    Ok(text_of(&controllers.join("Dockerfile"))?.unwrap_or_else(|| CONTROLLER_DOCKERFILE.to_owned()))
}

/// A directory of the project, which must not be a symlink to a path outside.
///
/// # Errors
/// When there is none, as text for the client.
pub fn inside(project: &Path, folder: &Path) -> Result<PathBuf, String> {
    let found = project
        .canonicalize()
        .and_then(|root| Ok((project.join(folder).canonicalize()?, root)));
    match found {
        Ok((found, root)) if found.starts_with(&root) && found.is_dir() => Ok(found),
        _ => Err(format!("The project has no folder {}", folder.display())),
    }
}

/// Makes the robot of a competition's participant an external controller: `controller "participant"` becomes
/// `controller "<extern>"` in the world.
///
/// # Errors
/// When the file can't be read or written. The project is the cause if it is not a text, or its image denies access.
fn open_participant(world: &Path) -> Result<(), Failure> {
    let open = || {
        let text = std::fs::read_to_string(world)?.replace("controller \"participant\"", "controller \"<extern>\"");
        let flags = OFlag::O_NOFOLLOW.bits();
        OpenOptions::new()
            .write(true)
            .truncate(true)
            .custom_flags(flags)
            .open(world)?
            .write_all(text.as_bytes())
    };
    open().map_err(|error| match error.kind() {
        ErrorKind::InvalidData | ErrorKind::PermissionDenied => {
            of_project(format!("The world can't be changed: {error}"))
        }
        _ => own_call_failed(&error),
    })
}

/// The image of Webots for a version: up to R2023a on Ubuntu 20.04, later ones on 22.04.
pub fn image_of(pattern: &str, version: &str) -> String {
    let ubuntu = if version < "R2023b" { "20.04" } else { "22.04" };
    pattern.replace("{version}", version).replace("{ubuntu}", ubuntu)
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
    let path = root
        .join("worlds")
        .join(&*name)
        .canonicalize()
        .ok()
        .filter(|path| path.is_file());
    let path = path.ok_or_else(|| format!("The image of this project has no worlds/{name}"))?;
    let inside = path.strip_prefix(root).ok().and_then(Path::to_str).map(str::to_owned);
    inside.ok_or_else(|| "The world is behind a link that leads out of its project".to_owned())
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
    Err(format!(
        "The path of the folder {name} of this project has a ':' or a line break, which containers can't have"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_image_follows_the_version() {
        let pattern = "cyberbotics/webots.cloud:{version}-ubuntu{ubuntu}";
        for (version, image) in [
            ("R2022b", "cyberbotics/webots.cloud:R2022b-ubuntu20.04"),
            ("R2023a", "cyberbotics/webots.cloud:R2023a-ubuntu20.04"),
            ("R2023b", "cyberbotics/webots.cloud:R2023b-ubuntu22.04"),
            ("R2025a", "cyberbotics/webots.cloud:R2025a-ubuntu22.04"),
        ] {
            assert_eq!(image_of(pattern, version), image);
        }
        assert_eq!(image_of("mine", "R2025a"), "mine");
    }

    fn read(project: &Path) -> Result<BuildPlan, String> {
        BuildPlan::read(project, "x")
    }

    #[test]
    fn an_image_is_built_only_where_there_is_something_to_build() {
        let project = tempfile::tempdir().unwrap();
        let plan = read(project.path()).unwrap();
        assert!(
            plan.image.folder.is_none()
                && plan.image.dockerfile.bases == ["${WEBOTS_DEFAULT_IMAGE}"]
                && plan.yml.warnings.is_empty()
        );
        std::fs::write(project.path().join("Makefile"), "all:\n").unwrap();
        let plan = read(project.path()).unwrap();
        assert!(
            plan.image.arguments.contains(&"MAKE=1".to_owned())
                && plan.image.folder == Some("")
                && plan.image.dockerfile.text.contains("LABEL webots-fleet.owner=x")
        );
        std::fs::write(project.path().join("Dockerfile"), "FROM mine\n").unwrap();
        let plan = read(project.path()).unwrap();
        assert!(
            plan.image
                .dockerfile
                .text
                .starts_with("FROM mine\nLABEL webots-fleet.owner=x\nRUN ")
        );
    }

    #[test]
    fn a_dockerfile_that_is_no_plain_file_is_refused_at_once() {
        let project = tempfile::tempdir().unwrap();
        let file = project.path().join("Dockerfile");
        std::os::unix::fs::symlink("/etc/passwd", &file).unwrap();
        assert!(read(project.path()).is_err());
        std::fs::remove_file(&file).unwrap();
        nix::unistd::mkfifo(&file, nix::sys::stat::Mode::S_IRWXU).unwrap();
        let wrong = read(project.path()).unwrap_err();
        assert_eq!(wrong, "Dockerfile of the project is no plain file of at most 256 KiB");
    }

    #[test]
    fn a_participant_is_run_from_outside() {
        let folder = tempfile::tempdir().unwrap();
        let world = folder.path().join("a.wbt");
        std::fs::write(
            &world,
            "Robot { controller \"participant\" }\nRobot { controller \"other\" }\n",
        )
        .unwrap();
        open_participant(&world).unwrap();
        let text = std::fs::read_to_string(world).unwrap();
        assert_eq!(
            text,
            "Robot { controller \"<extern>\" }\nRobot { controller \"other\" }\n"
        );
    }
}
