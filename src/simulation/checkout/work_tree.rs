//! A client's own copy of a project: its checkout by git, and its contents.

use std::ffi::OsString;
use std::io;
use std::path::Path;

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
pub fn checkout_command<'call>(
    repository: &'call Repository,
    revision: &Revision,
    paths: &[u8],
    (scratch, into): (&Path, &Path),
) -> io::Result<Call<'call>> {
    let list = scratch.join("paths");
    std::fs::write(&list, paths)?;
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

/// A written project.
#[derive(Debug, Clone, Copy)]
pub struct Written {
    /// Whether it is within the size limit: git's attributes may make it larger than the commit, and a Git host may send
    /// more than it should.
    pub fits: bool,
    /// Whether the cache has grown by its large files.
    pub has_grown: bool,
}

/// Writes a project with git, with its large files; `on_line` receives its progress lines. Blocks its thread.
///
/// # Errors
/// When git fails.
pub async fn write(
    found: &ResolvedCommit,
    instance: &InstanceDir,
    (limits, has_lfs): (&CheckoutLimits, bool),
    on_line: impl FnMut(&str),
) -> Result<Written, GitError> {
    let folder = if found.revision.folder.is_empty() { "." } else { &found.revision.folder };
    let paths = [folder.as_bytes(), b"\0", &found.above].concat();
    let project = instance.project();
    let mut call = checkout_command(&found.repository, &found.revision, &paths, (instance.path(), &project))?;
    call.may_block = true;
    // git-lfs stores its downloads here, shared with concurrent checkouts, and copies them into the project.
    let kept = call.repository.join("lfs");
    let before = if has_lfs { disk::room_of(&kept) } else { 0 };
    let mut growing = vec![(project, limits.size)];
    if has_lfs {
        call.settings = lfs::settings(&found.repository.remote());
        growing.push((kept.clone(), before.saturating_add(limits.size.saturating_mul(2))));
    }
    let fits = tokio::select! {
        written = found.repository.run(call, on_line) => written.map(|_| true)?,
        () = disk::outgrown(growing) => false,
    };
    Ok(Written { fits, has_grown: has_lfs && disk::room_of(&kept) > before })
}

/// Inspects a copy. Blocks.
pub fn inspect(world: &ProjectUrl, instance: &InstanceDir, revision: &Revision) -> WorkTree {
    let root = instance.project();
    let (folder, path) = (root.join(&revision.folder), root.join(revision.world_path(world)));
    let (size, pointers) = (disk::room_of(&root), lfs::pointers(&folder));
    WorkTree { size, pointers, world: WorldFile::open(&root, &path) }
}
