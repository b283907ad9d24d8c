//! A world file on disk: where it lies in its project, and how it is read. Reading blocks, so it is done
//! off the actors' threads.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use thiserror::Error;

use crate::kinds;
use crate::node::Node;
use crate::scene::{Scene, SceneError};
use crate::vrml::{self, SyntaxError};

/// What is shown when a world file makes no sense, so that viewers see something.
const EMPTY_WORLD: &str = "#VRML_SIM R2025a utf8\nWorldInfo { } Viewpoint { orientation 0 1 0 0.8 position -10 0 10 }";
/// Size of a world file, in bytes.
const LARGEST_FILE: u64 = 8 * 1024 * 1024;
const DEFAULT_TIME_STEP: f64 = 32.0;
const DEFAULT_FPS: f64 = 60.0;

/// A world that is ready to be simulated.
#[derive(Debug)]
pub(crate) struct World {
    /// Length of a step, in milliseconds.
    pub(crate) time_step: f64,
    /// Most updates per second that viewers are sent.
    pub(crate) fps: f64,
    /// What viewers see.
    pub(crate) scene: Scene,
}

/// The worlds of a project, as paths in it.
#[derive(Debug, Default)]
pub(crate) struct Names {
    /// The one that is simulated.
    pub(crate) current: String,
    /// All of them, by name.
    pub(crate) all: Vec<String>,
}

/// What came of loading a world file.
#[derive(Debug)]
pub(crate) struct Loaded {
    /// The worlds of the project.
    pub(crate) names: Names,
    /// The world, if it can be simulated.
    pub(crate) world: Result<World, WorldError>,
}

/// Why a world cannot be simulated.
#[derive(Debug, Error)]
pub(crate) enum WorldError {
    /// The file cannot be read.
    #[error("could not open file: '{}'", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The file is larger than allowed.
    #[error("the world file has more than {LARGEST_FILE} bytes")]
    TooLarge,
    /// The first line is not that of a world file.
    #[error("the first line must be '#VRML_SIM R2025a utf8' or that of an older release")]
    Header,
    /// The file cannot be parsed.
    #[error(transparent)]
    Syntax(#[from] SyntaxError),
    /// The file makes no scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

/// Where a world lies.
#[derive(Clone, Debug)]
pub(crate) struct WorldFile {
    path: PathBuf,
    project: PathBuf,
}

impl WorldFile {
    /// The world at `path`, whose project is the folder that holds `worlds`; a world that lies elsewhere
    /// has only its own folder for a project, so that no more than that is ever given away.
    pub(crate) fn new(path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let folder = path.parent().unwrap_or(Path::new("/"));
        let project = match folder.parent() {
            Some(project) if folder.ends_with("worlds") => project,
            _ => folder,
        };
        Self { project: project.to_owned(), path }
    }

    /// Where the file is.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The folder that holds the world's project.
    pub(crate) fn project(&self) -> &Path {
        &self.project
    }

    /// The world beside this one whose file is called as the last part of `name`, if there is one.
    pub(crate) fn sibling(&self, name: &str) -> Option<Self> {
        let path = self.path.with_file_name(Path::new(name).file_name()?);
        (is_world(&path) && path.exists()).then(|| Self { path, project: self.project.clone() })
    }

    /// Reads the file; blocks.
    pub(crate) fn load(&self) -> Loaded {
        Loaded { names: self.names(), world: self.read().and_then(|source| World::parse(&source)) }
    }

    fn names(&self) -> Names {
        let folder = self.path.parent().and_then(|folder| fs::read_dir(folder).ok());
        let entries = folder.into_iter().flatten().flatten();
        let paths = entries.map(|entry| entry.path()).filter(|path| is_world(path));
        let mut all: Vec<String> = paths.map(|path| self.name(&path)).collect();
        all.sort();
        Names { current: self.name(&self.path), all }
    }

    fn name(&self, path: &Path) -> String {
        path.strip_prefix(&self.project).unwrap_or(path).display().to_string()
    }

    fn read(&self) -> Result<String, WorldError> {
        let unreadable = |source| WorldError::Unreadable { path: self.path.clone(), source };
        if !is_world(&self.path) {
            return Err(unreadable(io::Error::other("not a .wbt file")));
        }
        let mut bytes = Vec::new();
        let file = File::open(&self.path).map_err(unreadable)?;
        let length = file.take(LARGEST_FILE + 1).read_to_end(&mut bytes).map_err(unreadable)?;
        if u64::try_from(length).is_ok_and(|length| length > LARGEST_FILE) {
            return Err(WorldError::TooLarge);
        }
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }
}

impl World {
    /// Makes a world of a file's text.
    pub(crate) fn parse(source: &str) -> Result<Self, WorldError> {
        let source = source.trim_start_matches('\u{feff}');
        if !source.lines().next().is_some_and(is_header) {
            return Err(WorldError::Header);
        }
        let mut nodes = vrml::parse(source)?; // to which the header is a comment
        if !nodes.iter().any(|node| node.kind.name == kinds::VIEWPOINT) {
            nodes.extend(vrml::parse(EMPTY_WORLD)?.into_iter().filter(|node| node.kind.name == kinds::VIEWPOINT));
        }
        let info = nodes.iter().find(|node| node.kind.name == kinds::WORLD_INFO);
        Ok(Self {
            time_step: setting(info, "basicTimeStep", DEFAULT_TIME_STEP).clamp(0.1, 10_000.0),
            fps: setting(info, "FPS", DEFAULT_FPS).clamp(1.0, 240.0),
            scene: Scene::new(&nodes)?,
        })
    }

    /// The world without anything in it.
    pub(crate) fn empty() -> Result<Self, WorldError> {
        Self::parse(EMPTY_WORLD)
    }
}

fn setting(info: Option<&Rc<Node>>, field: &str, default: f64) -> f64 {
    info.and_then(|info| info.numbers(field)).map_or(default, |[value]: [f64; 1]| value)
}

fn is_world(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("wbt"))
}

fn is_header(line: &str) -> bool {
    let mut words = line.split_whitespace();
    let release = |word: &str| word.starts_with(['R', 'V']) && word.len() > 1;
    words.next() == Some("#VRML_SIM") && words.next().is_some_and(release) && words.next() == Some("utf8")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn no_world_file_makes_the_loader_panic(
            words in prop::collection::vec(
                prop::sample::select(vec![
                    "WorldInfo", "Robot", "Solid", "Shape", "Box", "DEF", "USE", "A", "B", "{", "}", "{}", "[", "]",
                    "children", "geometry", "size", "name", "\"<&>\"", "translation", "rotation", "basicTimeStep",
                    "FPS", "1", "0", "-1e308", "1e-300", "TRUE", "NULL",
                ]),
                0..40,
            )
        ) {
            if let Ok(mut world) = World::parse(&format!("#VRML_SIM R2025a utf8\n{}", words.join(" "))) {
                drop(world.scene.changes(1e9));
            }
        }
    }

    #[test]
    fn the_header_is_checked() {
        for (line, good) in [
            ("#VRML_SIM R2025a utf8", true),
            ("#VRML_SIM R2023b utf8\r", true),
            ("#VRML_SIM V8.6.2 utf8", true),
            ("#VRML_SIM utf8", false),
            ("#VRML V2.0 utf8", false),
            ("WorldInfo { }", false),
            ("", false),
        ] {
            assert_eq!(World::parse(line).is_ok(), good, "{line}");
        }
    }

    #[test]
    fn timing_comes_from_the_file_within_limits() {
        for (fields, time_step, fps) in [
            ("", 32.0, 60.0),
            ("basicTimeStep 8 FPS 20", 8.0, 20.0),
            ("basicTimeStep 0 FPS 0", 0.1, 1.0),
            ("basicTimeStep -5 FPS 1e9", 0.1, 240.0),
        ] {
            let world = World::parse(&format!("#VRML_SIM R2025a utf8\nWorldInfo {{ {fields} }}")).unwrap();
            assert!((world.time_step - time_step).abs() < 1e-9 && (world.fps - fps).abs() < 1e-9, "{fields}");
        }
    }

    #[test]
    fn there_is_always_exactly_one_viewpoint() {
        for body in ["", "Viewpoint { }", "Group { }"] {
            let world = World::parse(&format!("#VRML_SIM R2025a utf8\n{body}")).unwrap();
            assert_eq!(world.scene.model.matches("<Viewpoint").count(), 1, "{body}");
        }
        assert!(World::empty().is_ok());
    }

    #[test]
    fn errors_name_the_line_of_the_file() {
        let error = World::parse("#VRML_SIM R2025a utf8\nGroup {\n]").unwrap_err();
        assert_eq!(error.to_string(), "line 3: expected a field or }, found ]");
    }

    #[test]
    fn the_project_is_the_folder_that_holds_worlds() {
        let file = WorldFile::new(Path::new("/p/worlds/a.wbt"));
        assert_eq!((file.project(), file.names().current.as_str()), (Path::new("/p"), "worlds/a.wbt"));
        let file = WorldFile::new(Path::new("/home/me/a.wbt"));
        assert_eq!((file.project(), file.names().current.as_str()), (Path::new("/home/me"), "a.wbt"));
    }

    #[test]
    fn siblings_exist_beside_the_world_whatever_path_is_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let worlds = folder.path().join("worlds");
        fs::create_dir(&worlds).unwrap();
        for name in ["a.wbt", "b.WBT", "notes.txt"] {
            fs::write(worlds.join(name), "").unwrap();
        }
        let file = WorldFile::new(&worlds.join("a.wbt"));
        assert_eq!(file.names().all, ["worlds/a.wbt", "worlds/b.WBT"]);
        for (name, found) in [
            ("b.WBT", true),
            ("worlds/b.WBT", true),
            ("../../x/b.WBT", true),
            ("c.wbt", false),
            ("notes.txt", false),
            ("..", false),
            ("", false),
        ] {
            assert_eq!(file.sibling(name).is_some(), found, "{name}");
        }
        assert!(file.read().is_ok());
        assert!(WorldFile::new(&worlds.join("notes.txt")).read().is_err());
    }
}
