//! Checks worlds out with git for clients: cached, joined, cancellable, with progress.
//!
//! First the commit is fetched into the cache (see [`super::commit_resolver`]); then each client gets its own copy of
//! the project's directory, written on a thread of its own. Dropping the handle cancels both.

use std::io;
use std::path::Path;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::cache_dir::CacheDir;
use super::checkout_error::{CheckoutError, git_failed, machine, too_large, too_slow};
use super::checkout_limits::CheckoutLimits;
use super::commit_resolver::CommitResolver;
use super::file_restore;
use super::git::Git;
use super::lfs;
use super::mirrors::Mirrors;
use super::project::Project;
use super::redirect;
use super::repository_cache::RepositoryCache;
use super::revision::Revision;
use super::single_flight::SharedProgress;
use super::steps;
use super::work_tree::{self, WorkTree, checkout_command};
use crate::shared::domain::{AdmissionRules, ProjectUrl};
use crate::simulation::process::{InstanceDir, on_own_thread};

/// Checks worlds out; one for the whole server.
pub struct CheckoutService {
    cache: Arc<RepositoryCache>,
    resolver: Arc<CommitResolver>,
    limits: CheckoutLimits,
    runtime: Handle,
    /// Limits the number of projects that are copied at a time.
    copies: Semaphore,
    has_lfs: bool,
    _keeps_within_budget: AbortOnDropHandle<()>,
}

/// Projects that are copied at a time: git may hold files in memory while it writes them.
const COPIES: usize = 16;

impl CheckoutService {
    /// Prepares checkouts, which are led on the thread of this runtime. `run` is the directory of this run of the server; the cached
    /// repositories may use `budget` bytes; `config` is a file of settings for git; `rules` limit redirects of Git
    /// hosts.
    ///
    /// # Errors
    /// When the cache can't be created.
    pub fn open(
        dir: CacheDir,
        run: &Path,
        budget: u64,
        (mirrors, config): (Mirrors, Option<&Path>),
        rules: AdmissionRules,
        limits: CheckoutLimits,
        runtime: Handle,
    ) -> io::Result<Self> {
        let git = Arc::new(Git::new(run, config, limits.stall_timeout()));
        let cache = Arc::new(RepositoryCache::open(dir, budget, git, limits)?);
        let resolver = Arc::new(CommitResolver::new(Arc::clone(&cache), (mirrors, rules), limits));
        let keeper = AbortOnDropHandle::new(runtime.spawn(Arc::clone(&cache).keep_within_budget()));
        let (copies, has_lfs) = (Semaphore::new(COPIES), lfs::is_installed());
        Ok(Self { cache, resolver, limits, runtime, copies, has_lfs, _keeps_within_budget: keeper })
    }

    /// Starts to check a world out into a client's directory. `progress` receives each step as text.
    pub fn start(
        self: &Arc<Self>,
        world: ProjectUrl,
        instance: InstanceDir,
        progress: impl Fn(String) + Send + Sync + 'static,
    ) -> AbortOnDropHandle<Result<Project, CheckoutError>> {
        let this = Arc::clone(self);
        let progress: SharedProgress = Arc::new(progress);
        let job = async move {
            let limit = this.limits.time;
            let done = actix_rt::time::timeout(limit, this.check_out(&world, instance, &progress)).await;
            done.unwrap_or_else(|_| Err(too_slow(&world, limit)))
        };
        AbortOnDropHandle::new(self.runtime.spawn(job))
    }

    async fn check_out(
        &self,
        world: &ProjectUrl,
        instance: InstanceDir,
        progress: &SharedProgress,
    ) -> Result<Project, CheckoutError> {
        let instance = Arc::new(instance);
        let (mut world, mut redirects, mut is_mended) = (world.clone(), 0, false);
        let checked_out = loop {
            match self.attempt(&world, &instance, progress).await {
                Err(CheckoutError::Moved(..)) if redirects < redirect::MAX_REDIRECTS => {
                    redirects += 1;
                    world = self.resolver.moved(&world).await?;
                }
                Err(error @ CheckoutError::Damaged(..)) if !is_mended => {
                    is_mended = true;
                    self.mend(&world, &error).await?;
                }
                done => break done,
            }
        };
        let (revision, WorkTree { size, pointers, world: file }) = checked_out?;
        let file = file?;
        let warning = (pointers > 0).then(|| lfs::warning(pointers, self.has_lfs));
        progress(steps::DONE.to_owned());
        Ok(Project {
            world: file,
            size,
            warnings: warning.into_iter().collect(),
            url: world,
            folder: instance.project().join(&revision.folder),
            revision,
            instance,
        })
    }

    /// Discards a cached repository that has turned out to be corrupt.
    async fn mend(&self, world: &ProjectUrl, failure: &CheckoutError) -> Result<(), CheckoutError> {
        log::warn!("{failure}. The cached repository is broken: it is fetched anew");
        self.resolver.discard(world).await
    }

    /// Resolves and copies a project, with its large files.
    async fn attempt(
        &self,
        world: &ProjectUrl,
        instance: &Arc<InstanceDir>,
        progress: &SharedProgress,
    ) -> Result<(Revision, WorkTree), CheckoutError> {
        let found = self.resolver.resolve(world, &**progress).await?;
        // It is never closed.
        let _turn = self.copies.acquire().await.ok();
        let (commit, revision) = (Arc::clone(&found), &found.revision);
        let (wanted, instance, progress) = (world.clone(), Arc::clone(instance), Arc::clone(progress));
        let (limits, has_lfs) = (self.limits, self.has_lfs);
        let copy = async move || {
            let name = &commit.revision.name;
            progress(steps::checking_out(name, None));
            let on_line = |line: &str| {
                if line.contains('%') {
                    progress(steps::checking_out(name, Some(line)));
                }
            };
            let written = work_tree::write(&commit, &instance, (&limits, has_lfs), on_line).await?;
            let copied = written.fits.then(|| work_tree::inspect(&wanted, &instance, &commit.revision));
            Ok((copied, written.has_grown))
        };
        let copied = on_own_thread(copy).await.map_err(|error| machine(world, &error))?;
        if self.has_lfs && !matches!(copied, Ok((_, false))) {
            self.cache.grown();
        }
        match copied.map_err(|source| git_failed(world, source))? {
            (Some(copied), _) if copied.size <= limits.size => Ok((revision.clone(), copied)),
            _ => Err(too_large("The project", limits.size)),
        }
    }

    /// Restores a file below the project's `controllers` directory to the state of the checkout.
    ///
    /// # Errors
    /// When it is not a file of the checkout there, or git fails.
    pub async fn restore_controller(&self, project: &Project, file: &str) -> Result<(), CheckoutError> {
        let refused = || CheckoutError::NoController(file.to_owned());
        let path = file_restore::controller(&project.revision.folder, file).ok_or_else(refused)?;
        let mut restored = self.restore(project, &path).await;
        if let Err(error @ CheckoutError::Damaged(..)) = &restored {
            self.mend(&project.url, error).await?;
            restored = self.restore(project, &path).await;
        }
        if restored? { Ok(()) } else { Err(refused()) }
    }

    /// Restores a file of a project's repository. Returns whether it exists.
    async fn restore(&self, project: &Project, path: &str) -> Result<bool, CheckoutError> {
        let Project { url, revision, instance, .. } = project;
        let Some(repository) = self.resolver.file(url, revision, path).await? else {
            return Ok(false);
        };
        let failed = |error| machine(url, &error);
        let restored = file_restore::prepare(instance.path()).map_err(failed)?;
        let paths = [path.as_bytes(), b"\0"].concat();
        let call = checkout_command(&repository, revision, &paths, (restored.path(), &restored.path().join("files")));
        repository.run(call.map_err(failed)?, |_| ()).await.map_err(|source| git_failed(url, source))?;
        file_restore::install(restored, instance.project(), path.to_owned()).await.map_err(failed)
    }
}
