//! The build plan of a checked-out project: its Dockerfiles, and the files that they need.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;

use super::dockerfile::Dockerfile;
use super::start_error::StartError;
use super::templates::{self, CONTROLLER_DOCKERFILE, DOCKERFILE, LAUNCHER, Template};
use super::webots_yml::{ProjectKind, WebotsYml, text_of};
use crate::simulation::config::ContainerSettings;

/// The path of a project in its container, as existing Dockerfiles expect.
pub const PROJECT_PATH: &str = "/usr/local/webots-project";

/// The build plan of a project.
#[derive(Debug)]
pub struct BuildPlan {
    /// What its `webots.yml` requests.
    pub yml: WebotsYml,
    /// The template for that.
    pub template: Template,
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

/// Arguments of the Dockerfile of a participant's controller.
const PARTICIPANT: [&str; 2] = ["WEBOTS_CONTROLLER_URL=participant", "DEFAULT_CONTROLLER=participant"];
/// The Dockerfile for a project that has nothing to build.
const NO_DOCKERFILE: &str = "ARG WEBOTS_DEFAULT_IMAGE\nFROM ${WEBOTS_DEFAULT_IMAGE}\n";
/// Files with which a project would configure its containers itself.
const IGNORED: [&str; 3] = ["docker-compose.yml", "docker-compose.yaml", ".env"];

impl BuildPlan {
    /// Reads a project, and adds the files that a competition needs. Blocks.
    ///
    /// # Errors
    /// The problem, in the project or in the administrator's template.
    pub fn read(project: &Path, settings: &ContainerSettings, owner: &str) -> Result<Self, StartError> {
        let mut yml = WebotsYml::read(project);
        let ignored = IGNORED.iter().filter(|name| project.join(name).symlink_metadata().is_ok());
        yml.warnings.extend(ignored.map(|name| format!("{name} of the project is not used here")));
        let has_makefile = project.join("Makefile").is_file();
        let dockerfile = match text_of(&project.join("Dockerfile"))? {
            None if has_makefile || templates::own(settings, DOCKERFILE).is_some() => {
                Some(templates::text(settings, DOCKERFILE)?.into_owned())
            }
            own => own,
        };
        let is_competition = yml.kind == ProjectKind::Competition;
        let controller = is_competition.then(|| competition(project, settings)).transpose()?;
        let build = |text: &str, folder, more: &[&str]| {
            let mut arguments =
                vec![format!("PROJECT_PATH={PROJECT_PATH}"), format!("MAKE={}", u8::from(has_makefile))];
            arguments.extend(more.iter().map(|argument| (*argument).to_owned()));
            Ok::<_, String>(ImageBuild { dockerfile: Dockerfile::read(text, owner)?, folder, arguments })
        };
        let image = match dockerfile {
            Some(text) => build(&text, Some(""), &[])?,
            None => build(NO_DOCKERFILE, None, &[])?,
        };
        let controller = controller.map(|text| build(&text, Some("controllers"), &PARTICIPANT)).transpose()?;
        let template = templates::compose(settings, yml.kind).map_err(StartError::Server)?;
        Ok(Self { yml, template, image, controller })
    }
}

/// The Dockerfile of a competition's controllers. Writes the launcher to the paths from which this one and the
/// project's can copy it.
fn competition(project: &Path, settings: &ContainerSettings) -> Result<String, String> {
    let controllers = inside(project, Path::new("controllers"))?;
    let launcher = templates::text(settings, LAUNCHER)?;
    for folder in [project, &controllers] {
        // The project's own file stays.
        match File::create_new(folder.join(LAUNCHER)).and_then(|mut file| file.write_all(launcher.as_bytes())) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(format!("{LAUNCHER} can't be written: {error}"));
            }
            _ => {}
        }
    }
    let own = text_of(&controllers.join("Dockerfile"))?;
    own.map_or_else(|| templates::text(settings, CONTROLLER_DOCKERFILE).map(String::from), Ok)
}

/// A directory of the project, which must not be a symlink to a path outside.
///
/// # Errors
/// When there is none, as text for the client.
pub fn inside(project: &Path, folder: &Path) -> Result<PathBuf, String> {
    let found = project.canonicalize().and_then(|root| Ok((project.join(folder).canonicalize()?, root)));
    match found {
        Ok((found, root)) if found.starts_with(&root) && found.is_dir() => Ok(found),
        _ => Err(format!("The project has no folder {}", folder.display())),
    }
}

/// Makes the robot of a competition's participant an external controller: `controller "participant"` becomes
/// `controller "<extern>"` in the world.
///
/// # Errors
/// When the file can't be read or written: the project's fault if it is no text, or its image has closed or replaced it.
pub fn open_participant(world: &Path) -> Result<(), StartError> {
    let open = || {
        let text = std::fs::read_to_string(world)?.replace("controller \"participant\"", "controller \"<extern>\"");
        let flags = OFlag::O_NOFOLLOW.bits();
        OpenOptions::new().write(true).truncate(true).custom_flags(flags).open(world)?.write_all(text.as_bytes())
    };
    open().map_err(|error| match error.kind() {
        ErrorKind::InvalidData | ErrorKind::PermissionDenied => {
            StartError::Project(format!("The world can't be changed: {error}"))
        }
        _ => error.into(),
    })
}

/// The image of Webots for a version: up to R2023a on Ubuntu 20.04, later ones on 22.04.
pub fn image_of(pattern: &str, version: &str) -> String {
    let ubuntu = if version < "R2023b" { "20.04" } else { "22.04" };
    pattern.replace("{version}", version).replace("{ubuntu}", ubuntu)
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

    fn read(project: &Path) -> Result<BuildPlan, StartError> {
        BuildPlan::read(project, &ContainerSettings::default(), "x")
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
        std::fs::write(project.path().join(".env"), "A=b").unwrap();
        let plan = read(project.path()).unwrap();
        assert!(
            plan.image.arguments.contains(&"MAKE=1".to_owned())
                && plan.image.folder == Some("")
                && plan.image.dockerfile.text.contains("LABEL webots-fleet.owner=x")
        );
        assert_eq!(plan.yml.warnings, [".env of the project is not used here"]);
        std::fs::write(project.path().join("Dockerfile"), "FROM mine\n").unwrap();
        let plan = read(project.path()).unwrap();
        assert!(plan.image.dockerfile.text.starts_with("FROM mine\nLABEL webots-fleet.owner=x\nRUN "));
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
        assert_eq!(wrong.to_string(), "Dockerfile of the project is no plain file of at most 256 KiB");
    }

    #[test]
    fn a_participant_is_run_from_outside() {
        let folder = tempfile::tempdir().unwrap();
        let world = folder.path().join("a.wbt");
        std::fs::write(&world, "Robot { controller \"participant\" }\nRobot { controller \"other\" }\n").unwrap();
        open_participant(&world).unwrap();
        let text = std::fs::read_to_string(world).unwrap();
        assert_eq!(text, "Robot { controller \"<extern>\" }\nRobot { controller \"other\" }\n");
    }
}
