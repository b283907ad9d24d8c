//! A client's own copy of a project: its checkout by git.

use std::ffi::{OsStr, OsString};
use std::io;
use std::path::Path;
use std::sync::Arc;

use rustix::process::Resource;

use super::checkout_error::{CheckoutError, git_failed, machine, refused, too_large};
use super::commit_resolver::ResolvedCommit;
use super::disk;
use super::git::LITTLE_MEMORY;
use super::lfs;
use super::project::Project;
use super::repository::Repository;
use super::revision::Revision;
use super::world_file::WorldFile;
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::{InstanceDir, Run};

/// A git command that writes these paths of a commit, each ended by a zero byte, into a directory, with these settings, each
/// as `name=value`. Its scratch files are in `scratch`.
///
/// # Errors
/// When the list of paths can't be written.
pub fn checkout_command(
    repository: &Repository,
    revision: &Revision,
    paths: &[u8],
    (scratch, into): (&Path, &Path),
    settings: &[String],
) -> io::Result<Run> {
    let (list, reference) = (scratch.join("paths"), OsString::from(revision.reference()));
    std::fs::write(&list, paths)?;
    let with = |option: &str, path: &Path| [OsStr::new(option), path.as_os_str()].join(OsStr::new(""));
    let mut arguments = vec![with("--work-tree=", into)];
    arguments.extend(["checkout", "--force", "--progress", "--pathspec-file-nul"].map(OsString::from));
    arguments.extend([with("--pathspec-from-file=", &list), reference.clone()]);
    let mut call = repository.configured(settings, &arguments);
    call.limits.push((Resource::Data, LITTLE_MEMORY));
    let index = scratch.join("index").into_os_string();
    call.spec.environment.extend([("GIT_INDEX_FILE".into(), index), ("GIT_ATTR_SOURCE".into(), reference)]);
    Ok(call)
}

/// Writes a project with git, with its large files if git-lfs is there; `on_line` receives git's progress lines. Blocks its
/// thread.
///
/// # Errors
/// Why it can't be checked out.
pub async fn write(
    found: &ResolvedCommit,
    world: &ProjectUrl,
    instance: &Arc<InstanceDir>,
    (limit, has_lfs): (u64, bool),
    on_line: impl FnMut(&str),
) -> Result<Project, CheckoutError> {
    let ResolvedCommit { repository, revision, above } = found;
    let folder = if revision.folder.is_empty() { "." } else { &revision.folder };
    let paths = [folder.as_bytes(), b"\0", above].concat();
    let (root, most) = (instance.project(), limit << 20);
    let settings = if has_lfs { lfs::settings(&repository.remote()) } else { Vec::new() };
    let call = checkout_command(repository, revision, &paths, (instance.path(), &root), &settings);
    let mut call = call.map_err(|error| machine(world, &error))?;
    call.may_block = true;
    // git-lfs stores its downloads here, shared with concurrent checkouts, and copies them into the project.
    let kept = repository.path.join("lfs");
    let before = if has_lfs { disk::room_of(&kept) } else { 0 };
    let mut growing = vec![(root.clone(), most)];
    if has_lfs {
        growing.push((kept.clone(), before.saturating_add(most.saturating_mul(2))));
    }
    let written = tokio::select! {
        written = repository.run(call, on_line) => written.map(|_| true),
        () = disk::outgrown(growing) => Ok(false),
    };
    if has_lfs && disk::room_of(&kept) > before {
        repository.growth.notify_one();
    }
    let size = disk::room_of(&root);
    // git's attributes may make it larger than the commit, and a Git host may send more than it should.
    if !written.map_err(|source| git_failed(world, &source))? || size > most {
        return Err(too_large("The project", limit));
    }
    let folder = root.join(&revision.folder);
    let pointers = lfs::pointers(&folder);
    Ok(Project {
        world: WorldFile::open(&root, &root.join(revision.world_path(world))).map_err(refused)?,
        size,
        warning: (pointers > 0).then(|| lfs::warning(pointers, has_lfs)),
        url: world.clone(),
        revision: revision.clone(),
        folder,
        instance: Arc::clone(instance),
    })
}
