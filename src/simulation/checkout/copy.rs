//! A client's own copy of a project: how git writes it, and what is in it.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::disk::{outgrown, size_of, stands_still};
use super::error::{CheckoutError, machine};
use super::finder::Found;
use super::git::{Call, Git};
use super::git_error::GitError;
use super::lfs::{self, Pointer};
use super::limits::Limits;
use super::refused::Scope;
use super::repository::Repository;
use super::revision::{ALL, Revision};
use super::world_file::{self, NoWorld, WorldFile};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// What is in a copy.
#[derive(Debug)]
pub struct Copied {
    /// How many bytes there are.
    pub size: u64,
    /// Files that only point to larger ones.
    pub pointers: Vec<Pointer>,
    /// Whether Git LFS is installed; not looked for where there are no such files.
    pub has_lfs: bool,
    /// The world.
    pub world: Result<WorldFile, NoWorld>,
    /// Where the project is that Webots sees, in its repository.
    pub place: Option<String>,
}

/// What to copy of a commit.
#[derive(Debug, Clone)]
pub enum What<'path> {
    /// The file or folder at this path of the repository.
    Path(&'path str),
    /// The paths in this file, each ended by a zero byte.
    Listed(PathBuf),
}

impl What<'_> {
    /// What a refusal of this is of.
    #[must_use]
    pub fn scope(&self, found: &Found) -> Scope {
        let folder = match self {
            Self::Path(path) => *path,
            Self::Listed(_) => found.revision.needed(),
        };
        Scope::folder(&found.repository.remote(), &found.revision, folder)
    }
}

/// Says what is copied of a commit for a client: the project's folder, and the files of the folders above it.
///
/// # Errors
/// When the list of these files can't be written.
pub async fn what<'found>(found: &'found Found, instance: &InstanceDir) -> std::io::Result<What<'found>> {
    let needed = found.revision.needed();
    if found.above.is_empty() || needed == ALL {
        return Ok(What::Path(needed));
    }
    let file = instance.path().join("paths");
    let list = [needed.as_bytes(), b"\0", &found.above].concat();
    tokio::fs::write(&file, list).await?;
    Ok(What::Listed(file))
}

/// Writes a part of a commit into the project's folder, or into another one. A client's copy has an index of its own.
#[must_use]
pub fn copy_call<'call>(
    repository: &'call Repository,
    revision: &Revision,
    (instance, into): (&InstanceDir, &Path),
    what: &What<'_>,
) -> Call<'call> {
    let mut work_tree = OsString::from("--work-tree=");
    work_tree.push(into);
    let reference = revision.reference();
    let mut arguments = vec![work_tree];
    arguments.extend(["checkout", "--force", "--progress"].map(OsString::from));
    match what {
        What::Path(path) => arguments.extend([&reference, "--", path].map(OsString::from)),
        What::Listed(file) => {
            let mut list = OsString::from("--pathspec-from-file=");
            list.push(file);
            arguments.extend([list, "--pathspec-file-nul".into(), reference.clone().into()]);
        }
    }
    let mut call = repository.call(arguments);
    call.environment.push(("GIT_INDEX_FILE".into(), instance.path().join("index").into()));
    call.environment.push(("GIT_ATTR_SOURCE".into(), reference.into()));
    call
}

/// Has git write a copy, and tell its progress line by line. Where it stands still it starts anew, each time with twice the
/// patience: only a few copies are made at a time. Returns whether what was written is small enough.
///
/// # Errors
/// When git fails.
pub async fn write(
    git: &Git,
    call: &Call<'_>,
    instance: &InstanceDir,
    (limits, repository): (&Limits, &Repository),
    mut told: impl FnMut(&str),
) -> Result<bool, GitError> {
    let mut patience = limits.patience();
    loop {
        let (mut is_too_large, mut is_silent) = (false, false);
        let project = instance.project();
        let end = async {
            tokio::select! {
                () = outgrown(&project, limits.size) => is_too_large = true,
                () = stands_still(&project, patience) => is_silent = true,
            }
        };
        match git.run_until(end, call.clone(), &mut told).await {
            _ if is_too_large => return Ok(false),
            Err(_) if is_silent => repository.tell_silence(patience),
            written => return written.map(|_| true),
        }
        patience *= 2;
        // The one that was killed has left it.
        tokio::fs::remove_file(instance.path().join("index.lock")).await.ok();
    }
}

/// Looks at a copy.
///
/// # Errors
/// When the machine fails.
pub async fn look(world: &ProjectUrl, instance: &InstanceDir, revision: &Revision) -> Result<Copied, CheckoutError> {
    let root = instance.project();
    let path = root.join(revision.world_path(world));
    let seen = actix_rt::task::spawn_blocking(move || {
        let size = size_of(&root);
        let project = world_file::project_of(&root, &path).map(|project| lfs::pointers(&project));
        let pointers = project.unwrap_or_default();
        let has_lfs = !pointers.is_empty() && lfs::is_installed();
        let world = WorldFile::open(&root, &path);
        let place = world.as_ref().ok().and_then(|world| {
            let project = world.path.ancestors().nth(2)?;
            Some(project.strip_prefix(root.canonicalize().ok()?).ok()?.to_str()?.to_owned())
        });
        Copied { size, pointers, has_lfs, world, place }
    });
    seen.await.map_err(|error| machine(world, &error.into()))
}
