//! A client's own copy of a project: its checkout by git.

use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use rustix::process::Resource;
use which::which;

use super::commit_resolver::ResolvedCommit;
use super::disk;
use super::git::LITTLE_MEMORY;
use super::project::{Project, WorldFile};
use super::repository::{CheckoutError, REMOTE, Repository, failed};
use super::revision::Revision;
use crate::shared::domain::{ProjectUrl, Reason};
use crate::simulation::config::Remote;
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
    let list = scratch.join("paths");
    let reference = OsString::from(revision.reference());
    std::fs::write(&list, paths)?;
    let words = [
        "checkout",
        "--force",
        "--progress",
        "--pathspec-file-nul",
        "--pathspec-from-file",
    ];
    let arguments = words
        .map(OsString::from)
        .into_iter()
        .chain([list.into(), reference.clone()]);
    let mut call = repository.configured(settings, &arguments.collect::<Vec<_>>());
    call.limits.push((Resource::Data, LITTLE_MEMORY));
    call.spec.environment.extend([
        ("GIT_WORK_TREE".into(), into.into()),
        ("GIT_INDEX_FILE".into(), scratch.join("index").into()),
        ("GIT_ATTR_SOURCE".into(), reference),
    ]);
    Ok(call)
}

/// Checks a project of at most `limit` MiB out, with its large files if git-lfs is installed; `on_line` receives git's
/// progress lines. Blocks its thread.
///
/// # Errors
/// Why it can't be checked out.
pub async fn write(
    found: &ResolvedCommit,
    world: &ProjectUrl,
    instance: &Arc<InstanceDir>,
    limit: u64,
    on_line: impl FnMut(&str),
) -> Result<Project, CheckoutError> {
    let ResolvedCommit {
        repository,
        generation,
        revision,
        above,
    } = found;
    let folder = if revision.folder.is_empty() {
        "."
    } else {
        &revision.folder
    };
    let paths = [folder.as_bytes(), b"\0", above].concat();
    let root = instance.project();
    let most = limit << 20;
    let settings = if which("git-lfs").is_ok() {
        lfs_settings(&repository.remote.lock())
    } else {
        Vec::new()
    };
    let mut call = checkout_command(repository, revision, &paths, (instance.path(), &root), &settings)?;
    call.may_block = true;
    // git-lfs stores its downloads here, shared with concurrent checkouts, and copies them into the project. Each checkout
    // downloads a file that is not there yet, and renames it then.
    let kept = repository.path.join("lfs");
    let running = repository.checkouts.begin();
    let before = disk::room_of(&kept);
    let growing = || {
        let growth = most.saturating_mul(2).saturating_mul(running.overlapping());
        vec![(root.clone(), most), (kept.clone(), before.saturating_add(growth))]
    };
    let written = tokio::select! {
        written = repository.git.run(call, on_line) => match written {
            Ok(_) => true,
            Err(error) => return Err(repository.unreadable(*generation, error).await),
        },
        () = disk::outgrown(growing) => false,
    };
    if disk::room_of(&kept) > before {
        repository.has_grown.store(true, Relaxed);
    }
    let size = disk::room_of(&root);
    // git's attributes may make it larger than the commit, and a Git host may send more than it should.
    if !written || size > most {
        let message = format!("The project is larger than {limit} MiB");
        return Err(failed(Reason::ProjectTooLarge, message));
    }
    Ok(Project {
        world: WorldFile::open(
            &root,
            &root.join(revision.path_of(&format!("worlds/{}", world.world()))),
        )
        .map_err(|why| failed(Reason::WorldNotFound, why))?,
        size,
        url: world.clone(),
        revision: revision.clone(),
        folder: root.join(&revision.folder),
        instance: Arc::clone(instance),
    })
}

/// Settings that make a checkout load large files from the repository's remote, whatever the repository configures.
fn lfs_settings(remote: &Remote) -> Vec<String> {
    let location = &remote.location;
    let url = match remote.protocol {
        "file" => format!("file://{location}"),
        _ => format!(
            "{}.git/info/lfs",
            location.trim_end_matches('/').trim_end_matches(".git")
        ),
    };
    vec![
        format!("lfs.url={url}"),
        // For a local directory, git-lfs reads this.
        format!("remote.{REMOTE}.url={url}"),
        "filter.lfs.process=git-lfs filter-process".to_owned(),
        "filter.lfs.smudge=git-lfs smudge -- %f".to_owned(),
        "filter.lfs.clean=git-lfs clean -- %f".to_owned(),
        "filter.lfs.required=false".to_owned(),
        // A file that can't be loaded stays a pointer.
        "lfs.skipdownloaderrors=true".to_owned(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_files_come_from_where_the_repository_is() {
        let first = |location: &str, protocol| {
            let location = location.to_owned();
            lfs_settings(&Remote { location, protocol })[0].clone()
        };
        assert_eq!(
            first("https://github.com/l/a.git", "https"),
            "lfs.url=https://github.com/l/a.git/info/lfs"
        );
        assert_eq!(
            first("https://forge.org/l/a", "https"),
            "lfs.url=https://forge.org/l/a.git/info/lfs"
        );
        assert_eq!(first("/mirror/l/a", "file"), "lfs.url=file:///mirror/l/a");
    }
}
