//! World files: their paths in their project, and their validity.

use std::fs::{self, File};
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::scene::{Scene, SceneError};

/// Longest first line, in bytes.
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
    #[error(transparent)]
    Scene(#[from] SceneError),
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

    /// Checks the world's first line and loads its scene. Blocks.
    pub(crate) fn load(&self) -> Result<Scene, WorldError> {
        let header = self.read_header().map_err(|source| WorldError::Unreadable {
            path: self.path.clone(),
            source,
        })?;
        if !is_header(&header) {
            return Err(WorldError::Header);
        }
        Ok(Scene::load(&self.path)?)
    }

    fn name(&self, path: &Path) -> String {
        path.strip_prefix(&self.project).unwrap_or(path).display().to_string()
    }

    fn read_header(&self) -> io::Result<String> {
        if !is_world(&self.path) {
            return Err(io::Error::other("not a .wbt file"));
        }
        let mut line = Vec::new();
        BufReader::new(File::open(&self.path)?.take(MAX_HEADER)).read_until(b'\n', &mut line)?;
        Ok(String::from_utf8_lossy(&line).into_owned())
    }
}

fn is_world(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("wbt"))
}

fn is_header(line: &str) -> bool {
    let mut words = line.trim_start_matches('\u{feff}').split_whitespace();
    let is_release = |word: &str| word.starts_with(['R', 'V']) && word.len() > 1;
    words.next() == Some("#VRML_SIM") && words.next().is_some_and(is_release) && words.next() == Some("utf8")
}
