//! Checks worlds out of git for clients: cached, deduplicated, cancellable, with progress.
//!
//! First the commit is brought into the cache (see [`super::fetcher`]); then each client gets its own copy of the
//! project's folder. Both run on the server's main thread as tasks: whoever drops the handle no longer waits.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use actix::prelude::*;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::errand::call;
use super::error::{CheckoutError, damaged, machine, too_large, too_slow};
use super::fetcher::{Fetched, Fetcher};
use super::git::Call;
use super::lfs::{self, Pointer};
use super::limits::Limits;
use super::revision::ALL;
use super::world_file::{self, NoWorld, WorldFile};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::InstanceDir;

/// Checks worlds out; one for the whole server.
pub struct Checkouts {
    fetcher: Arc<Fetcher>,
    limits: Limits,
    runtime: Handle,
    /// How many copies are made at a time: more would only be slower together.
    copies: Semaphore,
}

/// A step of a checkout, in words.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Progress(pub String);

/// A project that was checked out for one client.
#[derive(Debug)]
pub struct Project {
    /// The world to open.
    pub world: WorldFile,
    /// The commit.
    pub revision: String,
    /// What the client should know.
    pub warnings: Vec<String>,
    /// The project's folder.
    folder: PathBuf,
    /// Where the project is that Webots sees, in its repository: elsewhere if the world is behind a link.
    place: String,
    fetched: Arc<Fetched>,
    /// Removed with the project.
    pub instance: InstanceDir,
}

impl Checkouts {
    /// Prepares checkouts on the thread whose runtime this is.
    #[must_use]
    pub fn new(fetcher: Fetcher, limits: Limits, runtime: Handle) -> Self {
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        Self { fetcher: Arc::new(fetcher), limits, runtime, copies: Semaphore::new(2 * cores) }
    }

    /// Starts to check a world out into a client's folder. `progress` hears each step in words.
    pub fn start(
        self: &Arc<Self>,
        world: ProjectUrl,
        instance: InstanceDir,
        progress: impl Fn(String) + Send + Sync + 'static,
    ) -> AbortOnDropHandle<Result<Project, CheckoutError>> {
        let this = Arc::clone(self);
        let job = async move {
            let limit = this.limits.time;
            let done = actix_rt::time::timeout(limit, this.check_out(&world, instance, progress)).await;
            done.unwrap_or_else(|_| Err(too_slow(&world, limit)))
        };
        AbortOnDropHandle::new(self.runtime.spawn(job))
    }

    async fn check_out(
        &self,
        world: &ProjectUrl,
        instance: InstanceDir,
        progress: impl Fn(String) + Send + Sync,
    ) -> Result<Project, CheckoutError> {
        let copied = match self.fetch_and_copy(world, &instance, &progress).await {
            // A disk that failed, a crash, or somebody's hand: what is cached can be had again.
            Err(CheckoutError::Damaged { source, .. }) => {
                log::warn!("{world}: {source}");
                self.fetcher.mend(world).await.map_err(|error| machine(world, &error))?;
                self.fetch_and_copy(world, &instance, &progress).await
            }
            other => other,
        };
        let (fetched, folder) = copied?;
        let mut needed = fetched.revision.needed();
        let mut seen = look(world, &instance, &folder).await?;
        if needed != ALL && matches!(seen.1, Err(NoWorld::Dangling(_))) {
            // The world is a link itself, which may lead anywhere in its repository.
            self.fetcher.check_whole(world, &fetched).await?;
            needed = ALL;
            self.copy(world, &fetched, needed, &instance, &progress).await?;
            seen = look(world, &instance, &folder).await?;
        }
        let (pointers, file) = seen;
        let (pointers, file) = if pointers.is_empty() || !lfs::is_installed() {
            (pointers, file)
        } else {
            self.load_large_files(world, &fetched, needed, &instance, &pointers, &progress).await?;
            look(world, &instance, &folder).await?
        };
        let (file, pointers) = (file?, pointers.len());
        let warnings = (pointers > 0).then(|| lfs::warning(pointers));
        let revision = fetched.revision.commit.clone();
        let root = instance.path().join("project").canonicalize().map_err(|error| machine(world, &error))?;
        let seen = file.path.ancestors().nth(2).and_then(|project| project.strip_prefix(root).ok()?.to_str());
        let place = seen.unwrap_or(&fetched.revision.folder).to_owned();
        progress("checkout done".to_owned());
        Ok(Project {
            world: file,
            revision,
            warnings: warnings.into_iter().collect(),
            folder,
            place,
            fetched,
            instance,
        })
    }

    async fn fetch_and_copy(
        &self,
        world: &ProjectUrl,
        instance: &InstanceDir,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(Arc<Fetched>, PathBuf), CheckoutError> {
        let fetched = self.fetcher.fetched(world, progress).await?;
        let folder = self.copy(world, &fetched, fetched.revision.needed(), instance, progress).await?;
        Ok((fetched, folder))
    }

    /// Copies what is needed out of the cache. Gives back where the project's folder is.
    async fn copy(
        &self,
        world: &ProjectUrl,
        fetched: &Fetched,
        needed: &str,
        instance: &InstanceDir,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<PathBuf, CheckoutError> {
        let _turn = self.copies.acquire().await.map_err(|error| machine(world, &std::io::Error::other(error)))?;
        let tree = instance.path().join("project");
        tokio::fs::create_dir_all(&tree).await.map_err(|error| machine(world, &error))?;
        progress(format!("checking {} out", fetched.revision.name));
        let call = copy_call(fetched, instance, needed);
        let told = |line: &str| {
            if line.contains('%') {
                progress(line.to_owned());
            }
        };
        self.fetcher.git().run(call, told).await.map_err(|source| damaged(world, source))?;
        Ok(tree.join(&fetched.revision.folder))
    }

    /// Loads the files that the project keeps in Git LFS. Those that can't be had stay pointers.
    async fn load_large_files(
        &self,
        world: &ProjectUrl,
        fetched: &Fetched,
        needed: &str,
        instance: &InstanceDir,
        pointers: &[Pointer],
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(), CheckoutError> {
        if pointers.iter().fold(0_u64, |sum, pointer| sum.saturating_add(pointer.size)) > self.limits.size {
            return Err(too_large("What the project keeps in Git LFS".to_owned(), self.limits.size));
        }
        progress(format!("loading {} files from Git LFS", pointers.len()));
        for Pointer { path, .. } in pointers {
            // git writes again only what is not there.
            tokio::fs::remove_file(path).await.map_err(|error| machine(world, &error))?;
        }
        let mut call = copy_call(fetched, instance, needed);
        call.arguments.splice(0..0, lfs::settings(&fetched.remote));
        self.fetcher.git().run(call, |_| ()).await.map_err(|source| damaged(world, source))?;
        self.fetcher.shrink_soon();
        Ok(())
    }

    /// Restores a file below the project's `controllers` folder to the state of the checkout.
    ///
    /// # Errors
    /// When it is no file of the checkout there.
    pub async fn restore_controller(&self, project: &Project, file: &str) -> Result<(), CheckoutError> {
        let refused = || CheckoutError::NoController(file.to_owned());
        let plain = |segment: &str| !segment.is_empty() && segment != "." && segment != ".." && !segment.contains('\0');
        if !file.split('/').all(plain) || !file.contains('/') {
            return Err(refused());
        }
        let slash = if project.place.is_empty() { "" } else { "/" };
        let path = format!("{}{slash}controllers/{file}", project.place);
        let call = copy_call(&project.fetched, &project.instance, &path);
        self.fetcher.git().run(call, |_| ()).await.map(drop).map_err(|_| refused())
    }
}

fn copy_call<'call>(fetched: &'call Fetched, instance: &InstanceDir, path: &str) -> Call<'call> {
    let mut work_tree = OsString::from("--work-tree=");
    work_tree.push(instance.path().join("project"));
    let options = ["checkout", "--force", "--progress"].map(OsString::from);
    let what = [fetched.reference.as_str(), "--", path].map(OsString::from);
    let arguments = std::iter::once(work_tree).chain(options).chain(what).collect();
    let mut call = call(&fetched.remote, fetched.repository.path(), arguments);
    call.environment.push(("GIT_INDEX_FILE".into(), instance.path().join("index").into()));
    call.environment.push(("GIT_ATTR_SOURCE".into(), fetched.reference.clone().into()));
    call
}

/// What is in a copy: files that only point to larger ones, and the world.
async fn look(
    world: &ProjectUrl,
    instance: &InstanceDir,
    folder: &Path,
) -> Result<(Vec<Pointer>, Result<WorldFile, NoWorld>), CheckoutError> {
    let (root, folder) = (instance.path().join("project"), folder.to_owned());
    let path = folder.join("worlds").join(world.world());
    let seen = actix_rt::task::spawn_blocking(move || {
        let project = world_file::project_of(&root, &path).map(|project| lfs::pointers(&project));
        (project.unwrap_or_default(), WorldFile::open(&root, &path))
    });
    seen.await.map_err(|error| machine(world, &error.into()))
}

impl Project {
    /// The project's folder, with `worlds` and `controllers` inside.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}
