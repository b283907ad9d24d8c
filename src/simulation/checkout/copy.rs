//! A client's own copy of a project: how git writes it, and what is in it.

use std::ffi::OsString;

use super::error::{CheckoutError, machine};
use super::git::Call;
use super::lfs::{self, Pointer};
use super::repository::Repository;
use super::revision::Revision;
use super::world_file::{self, NoWorld, WorldFile};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// What is in a copy.
#[derive(Debug)]
pub struct Copied {
    /// Files that only point to larger ones.
    pub pointers: Vec<Pointer>,
    /// Whether Git LFS is installed; not looked for where there are no such files.
    pub has_lfs: bool,
    /// The world.
    pub world: Result<WorldFile, NoWorld>,
    /// Where the project is that Webots sees, in its repository.
    pub place: Option<String>,
}

/// Writes a part of a commit into a client's folder, which has an index of its own.
#[must_use]
pub fn copy_call<'call>(
    repository: &'call Repository,
    revision: &Revision,
    instance: &InstanceDir,
    path: &str,
) -> Call<'call> {
    let mut work_tree = OsString::from("--work-tree=");
    work_tree.push(instance.project());
    let reference = revision.reference();
    let rest = ["checkout", "--force", "--progress", &reference, "--", path].map(OsString::from);
    let mut call = repository.call(std::iter::once(work_tree).chain(rest).collect());
    call.environment.push(("GIT_INDEX_FILE".into(), instance.path().join("index").into()));
    call.environment.push(("GIT_ATTR_SOURCE".into(), reference.into()));
    call
}

/// Looks at a copy.
///
/// # Errors
/// When the machine fails.
pub async fn look(world: &ProjectUrl, instance: &InstanceDir, revision: &Revision) -> Result<Copied, CheckoutError> {
    let root = instance.project();
    let path = root.join(revision.world_path(world));
    let seen = actix_rt::task::spawn_blocking(move || {
        let project = world_file::project_of(&root, &path).map(|project| lfs::pointers(&project));
        let pointers = project.unwrap_or_default();
        let has_lfs = !pointers.is_empty() && lfs::is_installed();
        let world = WorldFile::open(&root, &path);
        let place = world.as_ref().ok().and_then(|world| {
            let project = world.path.ancestors().nth(2)?;
            Some(project.strip_prefix(root.canonicalize().ok()?).ok()?.to_str()?.to_owned())
        });
        Copied { pointers, has_lfs, world, place }
    });
    seen.await.map_err(|error| machine(world, &error.into()))
}
