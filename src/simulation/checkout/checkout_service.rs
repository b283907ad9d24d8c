//! Checks worlds out with git for clients: cached, joined, cancellable, with progress.
//!
//! First the commit is fetched into the cache (see [`super::commit_resolver`]); then each client gets its own copy of
//! the project's directory, written on a thread of its own. Dropping the handle cancels both.

use std::collections::HashMap;
use std::io;
use std::path::Path;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::commit_resolver::CommitResolver;
use super::git::{Git, timed_out};
use super::project::Project;
use super::repository::{CheckoutError, Repository, Unreadable, failed};
use super::repository_cache::RepositoryCache;
use super::revision::Tip;
use super::{file_restore, redirect, steps, work_tree};
use crate::shared::domain::{AdmissionRules, Failure, ProjectUrl, Reason};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{InstanceDir, on_own_thread};
use crate::simulation::progress::Progress;

/// Receives the progress of a checkout, on its thread.
pub type SharedProgress = Arc<dyn Fn(Progress) + Send + Sync>;

/// Checks worlds out; one for the whole server.
pub struct CheckoutService {
    resolver: Arc<CommitResolver>,
    config: Arc<SimulationConfig>,
    runtime: Handle,
    /// Limits the number of projects that are copied at a time.
    copies: Semaphore,
}

/// Keeps a repository in the cache until this is dropped.
pub struct KeptRepository {
    _repository: Arc<Repository>,
}

/// What a remote has said of worlds of one repository.
pub struct Tips {
    /// The commits that their URLs mean.
    pub tips: HashMap<ProjectUrl, Tip>,
    /// Keeps the repository in the cache.
    pub kept: KeptRepository,
}

/// Limit of concurrent copies of projects: git may hold files in memory while it writes them.
const COPIES: usize = 16;

impl CheckoutService {
    /// Prepares checkouts below `cacheDir`, which run on the current runtime. `run` is the directory of this run of the server; `rules`
    /// limit redirects of Git hosts.
    ///
    /// # Errors
    /// When the cache can't be created.
    pub fn open(cache: &Path, run: &Path, config: Arc<SimulationConfig>, rules: AdmissionRules) -> io::Result<Self> {
        let git = Arc::new(Git::new(run, Arc::clone(&config)));
        let cache = RepositoryCache::open(cache, git)?;
        let resolver = Arc::new(CommitResolver::new(cache, Arc::clone(&config), rules));
        let runtime = Handle::current();
        let copies = Semaphore::new(COPIES);
        Ok(Self {
            resolver,
            config,
            runtime,
            copies,
        })
    }

    /// Asks the remote once what the URLs of these worlds, all of one repository, mean now; and keeps the repository in the
    /// cache. Unless `is_due`, the remote is not asked.
    ///
    /// # Errors
    /// When it can't be asked.
    pub fn tips(
        self: &Arc<Self>,
        worlds: Vec<ProjectUrl>,
        is_due: bool,
    ) -> impl Future<Output = Result<Tips, Failure>> + use<> {
        let this = Arc::clone(self);
        async move {
            let limit = this.config.timing.checkout;
            let asked = actix_rt::time::timeout(limit, this.ask_tips(&worlds, is_due)).await;
            let asked = asked.unwrap_or_else(|_| Err(CheckoutError::OfRepository(timed_out(limit))));
            let about = |error: CheckoutError| match worlds.first() {
                Some(world) => error.about(world),
                None => Failure::new(Reason::ServerFault, "No world was named"),
            };
            asked.map_err(about)
        }
    }

    async fn ask_tips(&self, worlds: &[ProjectUrl], is_due: bool) -> Result<Tips, CheckoutError> {
        let mut current = worlds.to_vec();
        let mut redirects = 0;
        let (repository, tips) = loop {
            match self.resolver.tips(&current, is_due).await {
                Err(CheckoutError::Moved(location)) if redirects < redirect::MAX_REDIRECTS => {
                    redirects += 1;
                    for world in &mut current {
                        *world = self.resolver.moved(world, location.as_deref())?;
                    }
                }
                done => break done?,
            }
        };
        Ok(Tips {
            tips: worlds.iter().cloned().zip(tips).collect(),
            kept: KeptRepository {
                _repository: repository,
            },
        })
    }

    /// Starts to check a world out into a client's directory, at this tip if it is known. `progress` receives each step.
    pub fn start(
        self: &Arc<Self>,
        world: ProjectUrl,
        tip: Option<Tip>,
        instance: InstanceDir,
        progress: SharedProgress,
    ) -> AbortOnDropHandle<Result<Project, Failure>> {
        let this = Arc::clone(self);
        let job = async move {
            let mut world = world;
            let limit = this.config.timing.checkout;
            let done = actix_rt::time::timeout(limit, this.check_out(&mut world, tip, instance, &progress)).await;
            let done = done.unwrap_or_else(|_| Err(CheckoutError::OfRepository(timed_out(limit))));
            done.map_err(|error| error.about(&world))
        };
        AbortOnDropHandle::new(self.runtime.spawn(job))
    }

    /// Checks a world out. `world` follows redirects of its Git host.
    async fn check_out(
        &self,
        world: &mut ProjectUrl,
        tip: Option<Tip>,
        instance: InstanceDir,
        progress: &SharedProgress,
    ) -> Result<Project, CheckoutError> {
        let instance = Arc::new(instance);
        let mut redirects = 0;
        let mut mended = None;
        let project = loop {
            match self.attempt(world, tip.clone(), &instance, progress).await {
                Err(CheckoutError::Moved(location)) if redirects < redirect::MAX_REDIRECTS => {
                    redirects += 1;
                    *world = self.resolver.moved(world, location.as_deref())?;
                }
                Err(CheckoutError::Unreadable(unreadable)) if is_worth_another(&unreadable, mended) => {
                    mended = Some(discard(&unreadable).await?);
                }
                done => break done?,
            }
        };
        progress(steps::done());
        Ok(project)
    }

    /// Resolves and copies a project, with its large files.
    async fn attempt(
        &self,
        world: &ProjectUrl,
        tip: Option<Tip>,
        instance: &Arc<InstanceDir>,
        progress: &SharedProgress,
    ) -> Result<Project, CheckoutError> {
        let found = self.resolver.resolve(world, tip, &**progress).await?;
        // The semaphore is never closed.
        let _turn = self.copies.acquire().await.ok();
        let wanted = world.clone();
        let instance = Arc::clone(instance);
        let progress = Arc::clone(progress);
        let limit = self.config.project_size;
        let name = found.revision.name.clone();
        let copy = async move || {
            progress(steps::checking_out(&name, ""));
            let on_line = |line: &str| {
                if line.contains('%') {
                    progress(steps::checking_out(&name, line));
                }
            };
            work_tree::write(&found, &wanted, &instance, limit, on_line).await
        };
        on_own_thread(copy).await?
    }

    /// Restores a file below the project's `controllers` directory to the state of the checkout.
    ///
    /// # Errors
    /// When the checkout has no such file, or git fails.
    pub async fn restore_controller(&self, project: &Project, file: &str) -> Result<(), Failure> {
        let mut restored = self.restore(project, file).await;
        if let Err(CheckoutError::Unreadable(unreadable)) = &restored {
            restored = match discard(unreadable).await {
                Ok(_) => self.restore(project, file).await,
                Err(error) => Err(error.into()),
            };
        }
        restored.map_err(|error| error.about(&project.url))
    }

    async fn restore(&self, project: &Project, file: &str) -> Result<(), CheckoutError> {
        let Project { url, revision, .. } = project;
        let none = || {
            let message = format!("{file:?} is no file below the project's controllers folder");
            failed(Reason::NothingToReset, message)
        };
        let path = file_restore::controller(revision, file).ok_or_else(none)?;
        let found = self.resolver.file(url, revision, &path).await?;
        let (repository, generation) = found.ok_or_else(none)?;
        let is_there = file_restore::restore(&repository, generation, project, &path).await?;
        is_there.then_some(()).ok_or_else(none)
    }
}

/// Whether another attempt can succeed: nobody has fetched this repository anew since it was read, or this client has
/// not, as `mended`, its last new generation, shows. What can't be read in a new generation is the project's own content.
fn is_worth_another(unreadable: &Unreadable, mended: Option<u64>) -> bool {
    mended.is_none_or(|mended| unreadable.generation < mended)
}

/// Discards the generation of a repository that can't be read. Returns the generation that is in use then.
async fn discard(unreadable: &Unreadable) -> io::Result<u64> {
    let Unreadable {
        repository,
        generation,
        failure,
    } = unreadable;
    let output = failure.output.as_deref().unwrap_or_default();
    log::warn!("{repository:?} {failure}: {output}. It is fetched anew");
    repository.discard(*generation).await
}
