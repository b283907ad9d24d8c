//! Checks worlds out of git: cached, deduplicated, cancellable, with progress.
//!
//! First the commit is fetched into the cache (see [`super::repository_cache`]), at depth 1 and only if it is new;
//! everybody who waits for the same world shares that work. Then each client gets its own copy of the project's
//! folder. Both run on the server's main thread as tasks: whoever drops the handle no longer waits, and when nobody
//! waits any more git is ended.

use std::collections::HashMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, Shared, WeakShared};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, watch};
use tokio_util::task::AbortOnDropHandle;

use super::git::{Call, Git, GitError};
use super::instance_dir::InstanceDir;
use super::mirrors::{Mirrors, Remote};
use super::repository_cache::{InUse, RepositoryCache};
use super::revision::{self, Revision};
use super::world_file::{NoWorld, WorldFile};
use crate::shared::project_url::ProjectUrl;

/// Checks worlds out; one for the whole server.
pub struct Checkouts {
    git: Git,
    cache: RepositoryCache,
    mirrors: Mirrors,
    limits: Limits,
    runtime: Handle,
    /// What is being fetched now. An entry ends with the last client that waits for it.
    fetches: Mutex<HashMap<ProjectUrl, Fetch>>,
    /// How many copies are made at a time: more would only be slower together.
    copies: Semaphore,
}

/// What a checkout may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// For all of it.
    pub time: Duration,
    /// In bytes: what is fetched, and what is checked out.
    pub size: u64,
}

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
    fetched: Arc<Fetched>,
    /// Removed with the project.
    pub instance: InstanceDir,
}

/// Why a checkout failed. Its words are for the client.
#[derive(Debug, Clone, thiserror::Error)]
pub enum CheckoutError {
    /// No way to this forge.
    #[error(
        "This simulation server takes worlds from github.com and from the mirrors that it is configured with, not from {0}"
    )]
    Forge(String),
    /// The repository is not there.
    #[error("{0} does not exist or is not public")]
    NoRepository(String),
    /// The reference is not there.
    #[error("{repository} has no branch, tag or commit called {reference:?}")]
    NoReference {
        /// The repository's URL.
        repository: String,
        /// As the URL has it.
        reference: String,
    },
    /// The world can't be opened.
    #[error(transparent)]
    World(#[from] NoWorld),
    /// It took too long.
    #[error("Fetching {repository} took longer than {seconds} seconds")]
    TooSlow {
        /// The repository's URL.
        repository: String,
        /// The limit.
        seconds: u64,
    },
    /// It is too large.
    #[error("{what} is larger than {limit} MiB")]
    TooLarge {
        /// What.
        what: String,
        /// The limit.
        limit: u64,
    },
    /// git failed.
    #[error("{repository} can't be checked out: {source}")]
    Git {
        /// The repository's URL.
        repository: String,
        /// What git says.
        source: GitError,
    },
    /// The machine failed.
    #[error("{0} can't be checked out: {1}")]
    Machine(String, String),
    /// The file to restore is not there.
    #[error("{0:?} is no file below the project's controllers folder")]
    NoController(String),
}

/// A world's commit in the cache.
#[derive(Debug)]
struct Fetched {
    repository: InUse,
    remote: Remote,
    reference: String,
    revision: Revision,
}

#[derive(Clone)]
struct Fetch {
    progress: watch::Receiver<String>,
    result: WeakShared<BoxFuture<'static, Result<Arc<Fetched>, CheckoutError>>>,
}

/// Progress is told so often at most: nobody reads faster.
const BETWEEN_NEWS: Duration = Duration::from_millis(100);

type SharedFetch = Shared<BoxFuture<'static, Result<Arc<Fetched>, CheckoutError>>>;

impl Checkouts {
    /// Prepares checkouts on the thread whose runtime this is.
    #[must_use]
    pub fn new(git: Git, cache: RepositoryCache, mirrors: Mirrors, limits: Limits, runtime: Handle) -> Self {
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        let fetches = Mutex::default();
        Self { git, cache, mirrors, limits, runtime, fetches, copies: Semaphore::new(2 * cores) }
    }

    /// Starts to check a world out into a client's folder. `progress` hears each step in words.
    pub fn start(
        self: &Arc<Self>,
        world: ProjectUrl,
        instance: InstanceDir,
        progress: impl Fn(String) + Send + Sync + 'static,
    ) -> AbortOnDropHandle<Result<Project, CheckoutError>> {
        let this = Arc::clone(self);
        let job = async move { this.check_out(world, instance, progress).await };
        AbortOnDropHandle::new(self.runtime.spawn(job))
    }

    async fn check_out(
        self: Arc<Self>,
        world: ProjectUrl,
        instance: InstanceDir,
        progress: impl Fn(String) + Send + Sync,
    ) -> Result<Project, CheckoutError> {
        let fetched = self.fetched(&world, &progress).await?;
        let seconds = self.limits.time.as_secs();
        let too_slow = || CheckoutError::TooSlow { repository: world.repository(), seconds };
        let copied = actix_rt::time::timeout(self.limits.time, self.copy(&world, &fetched, &instance, &progress));
        let folder = copied.await.map_err(|_| too_slow())??;
        let path = folder.join("worlds").join(world.world());
        let (root, inside) = (instance.path().to_owned(), folder.clone());
        let opened = actix_rt::task::spawn_blocking(move || {
            WorldFile::open(&root, &path).map(|world| (world, revision::unresolved_lfs(&inside)))
        });
        let machine = |error: String| CheckoutError::Machine(world.repository(), error);
        let (file, pointers) = opened.await.map_err(|error| machine(error.to_string()))??;
        let warnings = (pointers > 0).then(|| {
            format!("Warning: {pointers} files of this project are kept in Git LFS and could not be loaded: they are missing")
        });
        let revision = fetched.revision.commit.clone();
        progress("checkout done".to_owned());
        Ok(Project { world: file, revision, warnings: warnings.into_iter().collect(), folder, fetched, instance })
    }

    /// Waits for the commit to be in the cache, together with everybody who waits for the same.
    async fn fetched(
        self: &Arc<Self>,
        world: &ProjectUrl,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<Arc<Fetched>, CheckoutError> {
        let (mut result, mut news) = self.join_or_start(world);
        let mut told: Option<Instant> = None;
        loop {
            tokio::select! {
                fetched = &mut result => return fetched,
                Ok(()) = news.changed() => {
                    let step = news.borrow_and_update().clone();
                    if told.is_none_or(|told| told.elapsed() >= BETWEEN_NEWS) {
                        told = Some(Instant::now());
                        progress(step);
                    }
                }
            }
        }
    }

    fn join_or_start(self: &Arc<Self>, world: &ProjectUrl) -> (SharedFetch, watch::Receiver<String>) {
        let mut fetches = self.fetches.lock().unwrap_or_else(PoisonError::into_inner);
        fetches.retain(|_, fetch| fetch.result.upgrade().is_some_and(|result| result.peek().is_none()));
        if let Some(fetch) = fetches.get(world)
            && let Some(result) = fetch.result.upgrade()
        {
            return (result, fetch.progress.clone());
        }
        let (sender, progress) = watch::channel(String::new());
        let (this, wanted) = (Arc::clone(self), world.clone());
        let job = async move {
            let repository = wanted.repository();
            let limit = this.limits.time;
            let found = actix_rt::time::timeout(limit, this.fetch(&wanted, &sender)).await;
            found.unwrap_or(Err(CheckoutError::TooSlow { repository, seconds: limit.as_secs() })).map(Arc::new)
        };
        let result = job.boxed().shared();
        if let Some(weak) = result.downgrade() {
            fetches.insert(world.clone(), Fetch { progress: progress.clone(), result: weak });
        }
        (result, progress)
    }

    /// Finds the commit that a world's URL means, and brings it into the cache if it is new.
    async fn fetch(&self, world: &ProjectUrl, progress: &watch::Sender<String>) -> Result<Fetched, CheckoutError> {
        let remote = self.mirrors.remote(world).ok_or_else(|| CheckoutError::Forge(world.host().to_owned()))?;
        let machine = |error: std::io::Error| CheckoutError::Machine(world.repository(), error.to_string());
        let repository = self.cache.take(&remote.location).await.map_err(machine)?;
        progress.send_replace(format!("looking for {}", world.repository()));
        let mut missing = None;
        for revision in self.revisions(world, &remote, &repository).await? {
            let reference = format!("refs/fleet/{}", revision.commit);
            if !repository.has(&reference) {
                self.download(world, &remote, &repository, &revision, progress).await?;
            }
            let call = self.call(&remote, repository.path(), revision.list_arguments(&reference));
            let listing = self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
            let listing = revision::Listing::parse(&listing);
            let limit = self.limits.size >> 20;
            if listing.size > self.limits.size {
                return Err(CheckoutError::TooLarge { what: "The project".to_owned(), limit });
            }
            if listing.has(&revision.world_path(world)) {
                return Ok(Fetched { repository, remote, reference, revision });
            }
            missing = Some(NoWorld::Missing(format!("{} in {}", revision.world_path(world), revision.name)));
        }
        Err(missing.map_or_else(|| no_reference(world), CheckoutError::World))
    }

    /// The commits that a URL may mean, the likeliest first.
    async fn revisions(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
    ) -> Result<Vec<Revision>, CheckoutError> {
        if let Some(commit) = revision::commit_of(world) {
            return Ok(vec![commit]);
        }
        let call = self.call(remote, repository.path(), revision::search_arguments(world, &remote.location));
        let answer = self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
        Ok(revision::found(world, &String::from_utf8_lossy(&answer)))
    }

    /// Fetches one commit, and ends git when it brings too much.
    async fn download(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
        revision: &Revision,
        progress: &watch::Sender<String>,
    ) -> Result<(), CheckoutError> {
        let machine = |error: std::io::Error| CheckoutError::Machine(world.repository(), error.to_string());
        let _fetching = repository.fetching().await.map_err(machine)?;
        if repository.has(&format!("refs/fleet/{}", revision.commit)) {
            return Ok(());
        }
        self.make_repository(world, remote, repository.path()).await?;
        let call = self.call(remote, repository.path(), revision.fetch_arguments(&remote.location));
        let tell = |line: &str| {
            if line.contains('%') {
                let step = line.trim_start_matches("remote: ");
                progress.send_replace(format!("fetching {}: {step}", world.repository()));
            }
        };
        let mut fetch = std::pin::pin!(self.git.run(call, tell));
        let mut look = actix_rt::time::interval(Duration::from_millis(200));
        loop {
            tokio::select! {
                result = &mut fetch => {
                    return result.map(drop).map_err(|source| fetch_failed(world, revision, source));
                }
                _ = look.tick() => {
                    if repository.received() > self.limits.size {
                        let what = format!("{} (at depth 1)", world.repository());
                        return Err(CheckoutError::TooLarge { what, limit: self.limits.size >> 20 });
                    }
                }
            }
        }
    }

    /// Makes the bare repository, unless it is there. It takes its place only when it is whole.
    async fn make_repository(&self, world: &ProjectUrl, remote: &Remote, path: &Path) -> Result<(), CheckoutError> {
        if path.join("HEAD").is_file() {
            return Ok(());
        }
        let machine = |error: std::io::Error| CheckoutError::Machine(world.repository(), error.to_string());
        let new = path.with_extension("new");
        for broken in [&new, path] {
            if broken.exists() {
                tokio::fs::remove_dir_all(broken).await.map_err(machine)?;
            }
        }
        let call = self.call(remote, &new, vec!["init".into(), "--quiet".into(), "--bare".into()]);
        self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
        tokio::fs::rename(&new, path).await.map_err(machine)?;
        let cache = self.cache.clone();
        // A new repository is when the budget may be passed. Nobody waits for that.
        drop(self.runtime.spawn_blocking(move || cache.shrink()));
        Ok(())
    }

    /// Copies the project's folder out of the cache. Gives back where it is.
    async fn copy(
        &self,
        world: &ProjectUrl,
        fetched: &Fetched,
        instance: &InstanceDir,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<PathBuf, CheckoutError> {
        let machine = |error: String| CheckoutError::Machine(world.repository(), error);
        let _turn = self.copies.acquire().await.map_err(|error| machine(error.to_string()))?;
        let tree = instance.path().join("project");
        tokio::fs::create_dir(&tree).await.map_err(|error| machine(error.to_string()))?;
        progress(format!("checking {} out", fetched.revision.name));
        let path = Some(fetched.revision.folder.as_str()).filter(|folder| !folder.is_empty()).unwrap_or(".");
        let call = self.copy_call(fetched, instance, path);
        let told = |line: &str| {
            if line.contains('%') {
                progress(line.to_owned());
            }
        };
        self.git.run(call, told).await.map_err(|source| git_failed(world, source))?;
        Ok(tree.join(&fetched.revision.folder))
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
        let folder = &project.fetched.revision.folder;
        let slash = if folder.is_empty() { "" } else { "/" };
        let path = format!("{folder}{slash}controllers/{file}");
        let call = self.copy_call(&project.fetched, &project.instance, &path);
        self.git.run(call, |_| ()).await.map(drop).map_err(|_| refused())
    }

    fn copy_call<'call>(&self, fetched: &'call Fetched, instance: &InstanceDir, path: &str) -> Call<'call> {
        let mut work_tree = OsString::from("--work-tree=");
        work_tree.push(instance.path().join("project"));
        let options = ["checkout", "--force", "--progress"].map(OsString::from);
        let what = [fetched.reference.as_str(), "--", path].map(OsString::from);
        let arguments = std::iter::once(work_tree).chain(options).chain(what).collect();
        let mut call = self.call(&fetched.remote, fetched.repository.path(), arguments);
        call.environment.push(("GIT_INDEX_FILE".into(), instance.path().join("index").into()));
        call.environment.push(("GIT_ATTR_SOURCE".into(), fetched.reference.clone().into()));
        call
    }

    #[expect(clippy::unused_self, reason = "it reads better beside the others")]
    fn call<'call>(&self, remote: &Remote, repository: &'call Path, arguments: Vec<OsString>) -> Call<'call> {
        Call { repository, arguments, protocol: remote.protocol, environment: Vec::new() }
    }
}

impl Project {
    /// The project's folder, with `worlds` and `controllers` inside.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

fn no_reference(world: &ProjectUrl) -> CheckoutError {
    let reference = world.candidates().into_iter().next().map(|reading| reading.reference).unwrap_or_default();
    CheckoutError::NoReference { repository: world.repository(), reference }
}

/// A commit that the remote does not know is the client's fault, not git's.
fn fetch_failed(world: &ProjectUrl, revision: &Revision, source: GitError) -> CheckoutError {
    let unknown = ["not our ref", "unadvertised object", "couldn't find remote ref", "remote did not send"];
    if revision.is_commit() && unknown.iter().any(|words| source.message.contains(words)) {
        return no_reference(world);
    }
    git_failed(world, source)
}

/// git asks for a password where a forge says 'not found': forges don't tell private from missing.
fn git_failed(world: &ProjectUrl, source: GitError) -> CheckoutError {
    let missing = ["could not read Username", "not found", "does not appear to be a git repository", "does not exist"];
    if missing.iter().any(|words| source.message.contains(words)) {
        return CheckoutError::NoRepository(world.repository());
    }
    CheckoutError::Git { repository: world.repository(), source }
}
