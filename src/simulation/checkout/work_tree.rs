//! A client's own copy of a project: its checkout by git, and its contents.

use std::ffi::OsString;
use std::io;
use std::path::Path;

use super::checkout_error::{CheckoutError, machine};
use super::checkout_limits::CheckoutLimits;
use super::commit_resolver::ResolvedCommit;
use super::disk;
use super::git::{Call, LITTLE_MEMORY};
use super::git_error::GitError;
use super::lfs;
use super::repository::Repository;
use super::revision::Revision;
use super::world_file::{WorldFile, WorldFileError};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// The contents of a copy.
#[derive(Debug)]
pub struct WorkTree {
    /// Its size in bytes, at least the space of an entry for each file and directory.
    pub size: u64,
    /// Number of LFS pointers whose files could not be loaded.
    pub pointers: usize,
    /// The world file, or why it can't be opened.
    pub world: Result<WorldFile, WorldFileError>,
}

/// A git command that writes these paths of a commit, each ended by a zero byte, into a directory. Its scratch files
/// are in `scratch`.
///
/// # Errors
/// When the list of paths can't be written.
pub async fn checkout_command<'call>(
    repository: &'call Repository,
    revision: &Revision,
    paths: &[u8],
    (scratch, into): (&Path, &Path),
) -> io::Result<Call<'call>> {
    let list = scratch.join("paths");
    tokio::fs::write(&list, paths).await?;
    let with = |option: &str, path: &Path| {
        let mut argument = OsString::from(option);
        argument.push(path);
        argument
    };
    let mut arguments = vec![with("--work-tree=", into)];
    arguments.extend(["checkout", "--force", "--progress", "--pathspec-file-nul"].map(OsString::from));
    arguments.extend([with("--pathspec-from-file=", &list), revision.reference().into()]);
    let mut call = Call { memory: LITTLE_MEMORY, ..repository.call(&arguments) };
    call.environment.push(("GIT_INDEX_FILE".into(), scratch.join("index").into()));
    call.environment.push(("GIT_ATTR_SOURCE".into(), revision.reference().into()));
    Ok(call)
}

/// Writes a project with git, with its large files; `on_line` receives its progress lines. Returns whether it is within
/// the size limit: git's attributes may make it larger than the commit, and a Git host may send more than it should.
///
/// # Errors
/// When git fails.
pub async fn write(
    found: &ResolvedCommit,
    instance: &InstanceDir,
    (limits, has_lfs): (&CheckoutLimits, bool),
    on_line: impl FnMut(&str),
) -> Result<bool, GitError> {
    let paths = [found.revision.needed().as_bytes(), b"\0", &found.above].concat();
    let project = instance.project();
    let call = checkout_command(&found.repository, &found.revision, &paths, (instance.path(), &project));
    let mut call = call.await?;
    let mut growing = vec![(project, limits.size)];
    if has_lfs {
        call.settings = lfs::settings(&found.repository.remote());
        // git-lfs stores its downloads here, shared with concurrent checkouts, and copies them into the project.
        let kept = call.repository.join("lfs");
        let measured = kept.clone();
        let before = disk::blocking(move || Ok(disk::room_of(&measured))).await?;
        growing.push((kept, before.saturating_add(limits.size.saturating_mul(2))));
    }
    tokio::select! {
        written = found.repository.run(call, on_line) => written.map(|_| true),
        () = disk::outgrown(growing) => Ok(false),
    }
}

/// Inspects a copy.
///
/// # Errors
/// When the machine fails.
pub async fn inspect(
    world: &ProjectUrl,
    instance: &InstanceDir,
    revision: &Revision,
) -> Result<WorkTree, CheckoutError> {
    let root = instance.project();
    let (folder, path) = (root.join(&revision.folder), root.join(revision.world_path(world)));
    let seen = disk::blocking(move || {
        let (size, pointers) = (disk::room_of(&root), lfs::pointers(&folder));
        Ok(WorkTree { size, pointers, world: WorldFile::open(&root, &path) })
    });
    seen.await.map_err(|error| machine(world, &error))
}
