//! A file of a project that is restored while its simulation runs.
//!
//! The simulation's programs may change every folder of the project at any moment, also between two steps of git: a link
//! in place of a folder would have git write elsewhere, in the name of the server. So git writes into a folder that a
//! sandbox does not show, and from there the file is moved into its folder, which the kernel looks up through no link.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use nix::fcntl::{AT_FDCWD, OFlag, OpenHow, ResolveFlag, openat2, renameat};
use tempfile::TempDir;

use super::disk::blocking;

/// A folder into which git writes what is restored, removed with this.
#[derive(Debug)]
pub struct FileRestore {
    folder: TempDir,
}

/// The path in its repository of a file below the `controllers` folder of the project at `place`; nothing where its name
/// leads elsewhere.
pub fn controller(place: &str, file: &str) -> Option<String> {
    let plain = |segment: &str| !segment.is_empty() && segment != "." && segment != ".." && !segment.contains('\0');
    let slash = if place.is_empty() { "" } else { "/" };
    (file.contains('/') && file.split('/').all(plain)).then(|| format!("{place}{slash}controllers/{file}"))
}

impl FileRestore {
    /// Makes the folder in the folder of an instance.
    ///
    /// # Errors
    /// When that can't be done.
    pub fn new(instance: &Path) -> io::Result<Self> {
        let folder = tempfile::Builder::new().prefix("restored-").tempdir_in(instance)?;
        let restored = Self { folder };
        std::fs::create_dir(restored.files())?;
        Ok(restored)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Where git writes the file.
    pub fn files(&self) -> PathBuf {
        self.path().join("files")
    }

    /// Moves the file at this path of the repository to the same path of the project. Returns false where its folder is
    /// none any more, or a folder has taken its place.
    ///
    /// # Errors
    /// When the project can't be opened.
    pub async fn place(self, project: PathBuf, path: String) -> io::Result<bool> {
        blocking(move || {
            let (above, name) = path.rsplit_once('/').unwrap_or((".", &path));
            let how = OpenHow::new().flags(OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_CLOEXEC);
            let how = how.resolve(ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_SYMLINKS);
            let folder = openat2(File::open(project)?, above, how);
            Ok(folder.is_ok_and(|folder| renameat(AT_FDCWD, &self.files().join(&path), folder, name).is_ok()))
        })
        .await
    }
}
