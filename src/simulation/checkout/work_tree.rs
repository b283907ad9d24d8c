//! A client's own copy of a project: how git writes it, and what is in it.

use std::ffi::OsString;
use std::io;
use std::path::Path;

use super::checkout_error::{CheckoutError, machine};
use super::checkout_limits::CheckoutLimits;
use super::commit_resolver::ResolvedCommit;
use super::disk::{self, Growing};
use super::git::{Call, Git, LITTLE_MEMORY};
use super::git_error::GitError;
use super::lfs;
use super::repository::Repository;
use super::revision::Revision;
use super::world_file::{WorldFile, WorldFileError};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// What is in a copy.
#[derive(Debug)]
pub struct WorkTree {
    /// How many bytes it takes.
    pub size: u64,
    /// How many files only point to larger ones, which could not be loaded.
    pub pointers: usize,
    /// The world.
    pub world: Result<WorldFile, WorldFileError>,
}

/// Has git write these paths of a commit, each ended by a zero byte, into a folder. What it needs besides is in `scratch`.
///
/// # Errors
/// When the list of paths can't be written.
pub async fn copy_call<'call>(
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

/// Has git write a project, with its large files, and tell its progress line by line. Returns whether it is small enough:
/// what is in the commit may be smaller than what git's attributes make of it, and a forge may send more than it should.
///
/// # Errors
/// When git fails.
pub async fn write(
    git: &Git,
    found: &ResolvedCommit,
    instance: &InstanceDir,
    (limits, has_lfs): (&CheckoutLimits, bool),
    told: impl FnMut(&str),
) -> Result<bool, GitError> {
    let paths = [found.revision.needed().as_bytes(), b"\0", &found.above].concat();
    let project = instance.project();
    let call = copy_call(&found.repository, &found.revision, &paths, (instance.path(), &project));
    let mut call = call.await?;
    let mut growing = vec![Growing::new(project, limits.size)];
    if has_lfs {
        call.settings = lfs::settings(&found.repository.remote());
        // git-lfs keeps what it loads here, into which others may load meanwhile, and copies it into the project.
        let kept = call.repository.join("lfs");
        let before = disk::blocking({
            let kept = kept.clone();
            move || Ok(disk::room_of(&kept))
        });
        let before = before.await?;
        growing.push(Growing::new(kept, before.saturating_add(limits.size.saturating_mul(2))));
    }
    tokio::select! {
        written = git.run(call, told) => written.map(|_| true),
        () = disk::outgrown(growing) => Ok(false),
    }
}

/// Looks at a copy.
///
/// # Errors
/// When the machine fails.
pub async fn look(world: &ProjectUrl, instance: &InstanceDir, revision: &Revision) -> Result<WorkTree, CheckoutError> {
    let root = instance.project();
    let (folder, path) = (root.join(&revision.folder), root.join(revision.world_path(world)));
    let seen = disk::blocking(move || {
        let (size, pointers) = (disk::room_of(&root), lfs::pointers(&folder));
        Ok(WorkTree { size, pointers, world: WorldFile::open(&root, &path) })
    });
    seen.await.map_err(|error| machine(world, &error))
}
