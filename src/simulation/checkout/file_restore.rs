//! Restores a file of a project while its simulation runs.
//!
//! The simulation's programs may change every directory of the project at any moment, also between two steps of git: a
//! symlink in place of a directory would make git write elsewhere with the server's rights. So git writes into a
//! directory that the sandbox does not mount, and the file is moved from there into its directory, which the kernel
//! resolves without symlinks.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use nix::fcntl::{AT_FDCWD, OFlag, OpenHow, ResolveFlag, openat2, renameat};
use tempfile::TempDir;

use super::disk::blocking;

/// The path in its repository of a file below the `controllers` folder of the project in `folder`; nothing where its name
/// leads elsewhere.
pub fn controller(folder: &str, file: &str) -> Option<String> {
    let plain = |segment: &str| !segment.is_empty() && segment != "." && segment != ".." && !segment.contains('\0');
    let slash = if folder.is_empty() { "" } else { "/" };
    (file.contains('/') && file.split('/').all(plain)).then(|| format!("{folder}{slash}controllers/{file}"))
}

/// Creates a directory in that of an instance, with scratch files of git and `files`, into which git writes the file.
///
/// # Errors
/// When that can't be done.
pub fn prepare(instance: &Path) -> io::Result<TempDir> {
    let folder = tempfile::Builder::new().prefix("restored-").tempdir_in(instance)?;
    std::fs::create_dir(folder.path().join("files"))?;
    Ok(folder)
}

/// Moves the file at this path of the repository to the same path of the project. Returns false if its parent is no
/// longer a directory, or a directory has replaced the file.
///
/// # Errors
/// When the project can't be opened.
pub async fn install(restored: TempDir, project: PathBuf, path: String) -> io::Result<bool> {
    blocking(move || {
        let (above, name) = path.rsplit_once('/').unwrap_or((".", &path));
        let how = OpenHow::new().flags(OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_CLOEXEC);
        let how = how.resolve(ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_SYMLINKS);
        let (folder, file) = (openat2(File::open(project)?, above, how), restored.path().join("files").join(&path));
        Ok(folder.is_ok_and(|folder| renameat(AT_FDCWD, &file, folder, name).is_ok()))
    })
    .await
}
