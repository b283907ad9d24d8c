//! A file of a project that is restored while its simulation runs.
//!
//! The simulation's programs may change every folder of the project at any moment, also between two steps of git: a link
//! in place of a folder would have git write elsewhere, in the name of the server. So git writes into a folder that a
//! sandbox does not show, and from there the file is moved to its place by way of open folders, through no link.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};

use nix::NixPath;
use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, OFlag, openat, renameat};
use nix::sys::stat::{Mode, mkdirat};
use nix::unistd::{UnlinkatFlags, unlinkat};
use tempfile::TempDir;

use super::disk::blocking;

/// A folder into which git writes what is restored, removed with this.
#[derive(Debug)]
pub struct Restored {
    folder: TempDir,
}

/// How often a folder is tried to be opened that somebody else keeps replacing.
const TRIES: usize = 10;

/// The path in its repository of a file below the `controllers` folder of the project at `place`; nothing where its name
/// leads elsewhere.
#[must_use]
pub fn controller(place: &str, file: &str) -> Option<String> {
    let plain = |segment: &str| !segment.is_empty() && segment != "." && segment != ".." && !segment.contains('\0');
    let slash = if place.is_empty() { "" } else { "/" };
    (file.contains('/') && file.split('/').all(plain)).then(|| format!("{place}{slash}controllers/{file}"))
}

impl Restored {
    /// Makes the folder in the folder of an instance.
    ///
    /// # Errors
    /// When that can't be done.
    pub fn new(instance: &Path) -> io::Result<Self> {
        let folder = tempfile::Builder::new().prefix("restored-").tempdir_in(instance)?;
        Ok(Self { folder })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Moves the file at this path of the repository to the same path of the project. What is a file or link there on its
    /// way becomes a folder.
    ///
    /// # Errors
    /// When it can't be moved, also where it has become a folder.
    pub async fn place(self, project: PathBuf, path: String) -> io::Result<()> {
        blocking(move || Ok(self.move_into(&project, &path)?)).await
    }

    fn move_into(self, project: &Path, path: &str) -> nix::Result<()> {
        let (above, name) = path.rsplit_once('/').unwrap_or(("", path));
        let mut folder = open(AT_FDCWD, project)?;
        for part in above.split('/').filter(|part| !part.is_empty()) {
            folder = enter(&folder, part)?;
        }
        renameat(AT_FDCWD, &self.path().join(path), &folder, name)
    }
}

/// Opens a folder in another one, and makes it where there is none.
fn enter(parent: &OwnedFd, name: &str) -> nix::Result<OwnedFd> {
    for _ in 0..TRIES {
        match open(parent, name) {
            Err(Errno::ENOENT) => {}
            Err(Errno::ELOOP | Errno::ENOTDIR) => match unlinkat(parent, name, UnlinkatFlags::NoRemoveDir) {
                // It was replaced again meanwhile.
                Ok(()) | Err(Errno::ENOENT | Errno::EISDIR) => {}
                Err(error) => return Err(error),
            },
            other => return other,
        }
        match mkdirat(parent, name, Mode::from_bits_truncate(0o777)) {
            Ok(()) | Err(Errno::EEXIST) => {}
            Err(error) => return Err(error),
        }
    }
    Err(Errno::ELOOP)
}

fn open<P: NixPath + ?Sized>(parent: impl AsFd, name: &P) -> nix::Result<OwnedFd> {
    let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
    openat(parent, name, flags, Mode::empty())
}
