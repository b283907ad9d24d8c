//! World files: their paths in their project, and their validity.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::phases::Phases;
use crate::scene::{Scene, SceneError};

/// Length of the part of a world that is read, in bytes: its first line and the comments after it.
const MAX_HEADER: u64 = 1024;

/// The worlds of a project, as paths in it.
#[derive(Debug, Default)]
pub(crate) struct WorldNames {
    /// The one that is simulated.
    pub(crate) current: String,
    /// All of them, sorted.
    pub(crate) all: Vec<String>,
}

/// Why a world cannot be simulated.
#[derive(Debug, Error)]
pub(crate) enum WorldError {
    #[error("could not open file: '{}'", path.display())]
    Unreadable { path: PathBuf, source: io::Error },
    #[error("the first line must be '#VRML_SIM R2025a utf8' or that of an older release")]
    Header,
    #[error("the demo simulator has no option '{0}'")]
    Phases(String),
    #[error(transparent)]
    Scene(#[from] SceneError),
}

/// What the beginning of a world says.
#[derive(Clone, Debug)]
pub(crate) struct Header {
    /// The release of Webots that the world was made for, which this program then is.
    pub(crate) release: Release,
    /// What makes it slow.
    pub(crate) phases: Phases,
}

/// A release of Webots, such as `R2025a`.
#[derive(Clone, Debug)]
pub(crate) struct Release(String);

impl Release {
    /// The message with which a client requests the scene: releases know only one of two.
    pub(crate) fn scene_request(&self) -> &'static str {
        if self.is_since("R2025a") { "w3d" } else { "x3d" }
    }

    /// Whether controllers are answered before there is a world.
    pub(crate) fn answers_controllers_at_once(&self) -> bool {
        self.is_since("R2023b")
    }

    fn is_since(&self, release: &str) -> bool {
        self.0.starts_with('R') && *self.0 >= *release
    }
}

impl Default for Release {
    /// That of the program itself.
    fn default() -> Self {
        Self("R2025a".to_owned())
    }
}

/// The paths of a world and its project.
#[derive(Clone, Debug)]
pub(crate) struct WorldFile {
    path: PathBuf,
    project: PathBuf,
}

impl WorldFile {
    /// The world at `path`. Its project is the parent of the directory `worlds`; the world's own directory if that has
    /// another name.
    pub(crate) fn new(path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let folder = path.parent().unwrap_or(Path::new("/"));
        let project = match folder.parent() {
            Some(project) if folder.ends_with("worlds") => project,
            _ => folder,
        };
        Self {
            project: project.to_owned(),
            path,
        }
    }

    /// The absolute path of the world file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The directory of the world's project.
    pub(crate) fn project(&self) -> &Path {
        &self.project
    }

    /// Returns the world in the same directory with the file name of `path`, if there is one.
    pub(crate) fn sibling(&self, path: &str) -> Option<Self> {
        let path = self.path.with_file_name(Path::new(path).file_name()?);
        (is_world(&path) && path.exists()).then(|| Self {
            path,
            project: self.project.clone(),
        })
    }

    /// Returns the names of the project's worlds. Blocks.
    pub(crate) fn names(&self) -> WorldNames {
        let folder = self.path.parent().and_then(|folder| fs::read_dir(folder).ok());
        let paths = folder.into_iter().flatten().flatten().map(|entry| entry.path());
        let mut all: Vec<String> = paths
            .filter(|path| is_world(path))
            .map(|path| self.name(&path))
            .collect();
        all.sort();
        WorldNames {
            current: self.name(&self.path),
            all,
        }
    }

    /// Reads the world's first line and its options. Blocks.
    pub(crate) fn header(&self) -> Result<Header, WorldError> {
        let text = self.beginning().map_err(|source| WorldError::Unreadable {
            path: self.path.clone(),
            source,
        })?;
        let release = release(text.lines().next().unwrap_or_default()).ok_or(WorldError::Header)?;
        let phases = Phases::parse(&text).map_err(WorldError::Phases)?;
        Ok(Header { release, phases })
    }

    /// Loads the world's scene. Blocks.
    pub(crate) fn load(&self) -> Result<Scene, WorldError> {
        Ok(Scene::load(&self.path, &self.project)?)
    }

    fn name(&self, path: &Path) -> String {
        path.strip_prefix(&self.project).unwrap_or(path).display().to_string()
    }

    fn beginning(&self) -> io::Result<String> {
        if !is_world(&self.path) {
            return Err(io::Error::other("not a .wbt file"));
        }
        let mut text = Vec::new();
        File::open(&self.path)?.take(MAX_HEADER).read_to_end(&mut text)?;
        Ok(String::from_utf8_lossy(&text).into_owned())
    }
}

fn is_world(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("wbt"))
}

/// The release in the first line of a world; `None` if that is not one.
fn release(line: &str) -> Option<Release> {
    let line = line.trim_start_matches('\u{feff}');
    match line.split_whitespace().collect::<Vec<_>>().as_slice() {
        ["#VRML_SIM", release, "utf8", ..] if release.starts_with(['R', 'V']) && release.len() > 1 => {
            Some(Release((*release).to_owned()))
        }
        _ => None,
    }
}
