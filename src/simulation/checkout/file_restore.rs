//! Restores a file of a project while its simulation runs.
//!
//! The simulation's programs may change every directory of the project at any moment, also between two steps of git: a
//! symlink in place of a directory would make git write elsewhere with the server's rights. So git writes into a
//! directory that the sandbox does not mount, and the file is moved from there into its directory, which the kernel
//! resolves without symlinks.

use std::fs::File;
use std::sync::Arc;

use nix::fcntl::{AT_FDCWD, OFlag, OpenHow, ResolveFlag, openat2, renameat};

use super::project::Project;
use super::repository::{CheckoutError, Repository};
use super::revision::Revision;
use super::work_tree::checkout_command;

/// The path in its repository of a file below a project's `controllers` directory; `None` if its name could leave it.
pub fn controller(revision: &Revision, file: &str) -> Option<String> {
    let plain = |segment: &str| !segment.is_empty() && segment != "." && segment != ".." && !segment.contains('\0');
    (file.contains('/') && file.split('/').all(plain)).then(|| revision.path_of(&format!("controllers/{file}")))
}

/// Restores the file at this path of the repository to its commit. Returns false if its directory is no longer one, or
/// a directory has replaced the file.
///
/// # Errors
/// When git or the disk fails.
pub async fn restore(
    repository: &Arc<Repository>,
    generation: u64,
    project: &Project,
    path: &str,
) -> Result<bool, CheckoutError> {
    let scratch = tempfile::Builder::new()
        .prefix("restored-")
        .tempdir_in(project.instance.path())?;
    let files = scratch.path().join("files");
    std::fs::create_dir(&files)?;
    let paths = [path.as_bytes(), b"\0"].concat();
    let call = checkout_command(repository, &project.revision, &paths, (scratch.path(), &files), &[])?;
    if let Err(error) = repository.git.run(call, |_| ()).await {
        return Err(repository.unreadable(generation, error).await);
    }
    let (above, name) = path.rsplit_once('/').unwrap_or((".", path));
    let how = OpenHow::new().flags(OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_CLOEXEC);
    let how = how.resolve(ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_SYMLINKS);
    let folder = openat2(File::open(project.instance.project())?, above, how);
    Ok(folder.is_ok_and(|folder| renameat(AT_FDCWD, &files.join(path), folder, name).is_ok()))
}
