//! Checks worlds out of git for clients: cached, joined, cancellable, with progress.
//!
//! First the commit is brought into the cache (see [`super::finder`]); then each client gets its own copy of the
//! project's folder. Both run on the server's main thread as tasks: whoever drops the handle no longer waits.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::cache::Cache;
use super::cache_dir::CacheDir;
use super::copy::{self, Copied, What, copy_call, look, what};
use super::error::{CheckoutError, git_failed, machine, too_large, too_slow};
use super::finder::{Finder, Found};
use super::git::Git;
use super::lfs::{self, Pointer};
use super::limits::Limits;
use super::mirrors::Mirrors;
use super::project::Project;
use super::redirect;
use super::restored::{self, Restored};
use super::revision::{ALL, Revision};
use super::steps;
use super::world_file::NoWorld;
use crate::shared::domain::{ProjectUrl, Rules};
use crate::simulation::process::InstanceDir;

/// Checks worlds out; one for the whole server.
pub struct Checkouts {
    git: Arc<Git>,
    cache: Arc<Cache>,
    finder: Arc<Finder>,
    limits: Limits,
    runtime: Handle,
    /// How many MiB of projects are copied at a time. git may hold files in memory as it writes them.
    copies: Semaphore,
    _keeps_within_budget: AbortOnDropHandle<()>,
}

/// How many MiB of projects are copied at a time: many small ones, of which a class may start at once, or a few large ones.
const COPIED: u32 = 2048;
/// What a project counts at least, in MiB: git itself.
const SMALLEST: u32 = 32;

/// A step of a checkout, in words.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Progress(pub String);

impl Checkouts {
    /// Prepares checkouts on the thread whose runtime this is. `run` is the folder of this run of the server; the
    /// cached repositories may take `budget` bytes; `config` is a file of settings for git; `rules` say where a forge may
    /// send to.
    ///
    /// # Errors
    /// When the cache can't be made.
    pub fn open(
        dir: CacheDir,
        run: &Path,
        budget: u64,
        (mirrors, config): (Mirrors, Option<&Path>),
        rules: Rules,
        limits: Limits,
        runtime: Handle,
    ) -> io::Result<Self> {
        let git = Arc::new(Git::new(run, config));
        let cache = Arc::new(Cache::open(dir, budget, Arc::clone(&git), limits)?);
        let finder = Arc::new(Finder::new(Arc::clone(&git), Arc::clone(&cache), (mirrors, rules), limits));
        let keeper = AbortOnDropHandle::new(runtime.spawn(Arc::clone(&cache).keep_within_budget()));
        let copies = Semaphore::new(usize::try_from(COPIED).unwrap_or(usize::MAX));
        Ok(Self { git, cache, finder, limits, runtime, copies, _keeps_within_budget: keeper })
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
        let start = Instant::now();
        let (mut world, mut redirects, mut is_mended) = (world.clone(), 0, false);
        let checked_out = loop {
            match self.attempt(&world, &instance, &progress).await {
                Err(CheckoutError::Moved(..)) if redirects < redirect::MOST => {
                    redirects += 1;
                    world = self.finder.moved(&world).await?;
                }
                Err(error) if !is_mended => {
                    is_mended = true;
                    self.mend(&world, start, error).await?;
                }
                done => break done,
            }
        };
        let (revision, Copied { pointers, has_lfs, world: file, place, .. }) = checked_out?;
        let file = file?;
        let warning = (!pointers.is_empty()).then(|| lfs::warning(pointers.len(), has_lfs));
        progress(steps::DONE.to_owned());
        Ok(Project {
            world: file,
            warnings: warning.into_iter().collect(),
            url: world,
            folder: instance.project().join(&revision.folder),
            place: place.unwrap_or_else(|| revision.folder.clone()),
            revision,
            instance,
        })
    }

    /// Throws a cached repository away that was found to be broken, unless it was made after `since`: it can be fetched
    /// anew.
    ///
    /// # Errors
    /// The failure, if it is another one.
    async fn mend(&self, world: &ProjectUrl, since: Instant, failure: CheckoutError) -> Result<(), CheckoutError> {
        let CheckoutError::Damaged { .. } = &failure else {
            return Err(failure);
        };
        log::warn!("{failure}. The cached repository is broken: it is fetched anew");
        self.finder.discard(world, since).await
    }

    /// Finds and copies a project, with its large files.
    async fn attempt(
        &self,
        world: &ProjectUrl,
        instance: &InstanceDir,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(Revision, Copied), CheckoutError> {
        let found = self.finder.find(world, progress).await?;
        let mut needed = what(&found, instance).await.map_err(|error| machine(world, &error))?;
        self.copy(world, &found, &needed, instance, progress).await?;
        let mut copied = look(world, instance, &found.revision).await?;
        if found.revision.needed() != ALL && matches!(copied.world, Err(NoWorld::Dangling(_))) {
            // The world is a link itself, which may lead anywhere in its repository.
            self.finder.check_whole(world, &found).await?;
            needed = What::Path(ALL);
            self.copy(world, &found, &needed, instance, progress).await?;
            copied = look(world, instance, &found.revision).await?;
        }
        if copied.has_lfs && !copied.pointers.is_empty() {
            self.load_large_files(world, &found, &needed, instance, &copied.pointers, progress).await?;
            copied = look(world, instance, &found.revision).await?;
        }
        if copied.size > self.limits.size {
            return self.refuse(&found, &needed);
        }
        Ok((found.revision.clone(), copied))
    }

    /// Copies what is needed out of the cache.
    async fn copy(
        &self,
        world: &ProjectUrl,
        found: &Found,
        needed: &What<'_>,
        instance: &InstanceDir,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(), CheckoutError> {
        let weight = u32::try_from(found.size >> 20).unwrap_or(u32::MAX).clamp(SMALLEST, COPIED);
        let turn = self.copies.acquire_many(weight).await;
        let _turn = turn.map_err(|error| machine(world, &io::Error::other(error)))?;
        self.finder.refused().check(&needed.scope(found))?;
        let name = &found.revision.name;
        progress(steps::checking_out(name, None));
        let project = instance.project();
        let call = copy_call(&found.repository, &found.revision, (instance, &project), needed);
        let told = |line: &str| {
            if line.contains('%') {
                progress(steps::checking_out(name, Some(line)));
            }
        };
        match copy::write(&self.git, &call, instance, (&self.limits, &found.repository), told).await {
            Ok(true) => Ok(()),
            // What is in the commit may be smaller than what git's attributes make of it.
            Ok(false) => self.refuse(found, needed),
            Err(source) => Err(git_failed(world, source)),
        }
    }

    /// Refuses what was copied of a commit: it is too large, and so it is for everybody else.
    fn refuse<T>(&self, found: &Found, needed: &What<'_>) -> Result<T, CheckoutError> {
        let refusal = too_large("The project".to_owned(), self.limits.size);
        self.finder.refused().note(needed.scope(found), Err(refusal))
    }

    /// Loads the files that the project keeps in Git LFS. Those that can't be had stay pointers.
    async fn load_large_files(
        &self,
        world: &ProjectUrl,
        found: &Found,
        needed: &What<'_>,
        instance: &InstanceDir,
        pointers: &[Pointer],
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(), CheckoutError> {
        if pointers.iter().fold(0_u64, |sum, pointer| sum.saturating_add(pointer.size)) > self.limits.size {
            return Err(too_large("What the project keeps in Git LFS".to_owned(), self.limits.size));
        }
        progress(steps::loading_large(pointers.len()));
        for Pointer { path, .. } in pointers {
            // git writes again only what is not there.
            tokio::fs::remove_file(path).await.map_err(|error| machine(world, &error))?;
        }
        let project = instance.project();
        let mut call = copy_call(&found.repository, &found.revision, (instance, &project), needed);
        call.settings = lfs::settings(&found.repository.remote());
        let cached = call.repository.join("lfs");
        let mut is_too_large = false;
        let end = async {
            lfs::outgrown(&project, &cached, self.limits.size).await;
            is_too_large = true;
        };
        let loaded = self.git.run_until(end, call, |_| ()).await;
        self.cache.grown();
        if is_too_large {
            return Err(too_large("What the project keeps in Git LFS".to_owned(), self.limits.size));
        }
        loaded.map(drop).map_err(|source| git_failed(world, source))
    }

    /// Restores a file below the project's `controllers` folder to the state of the checkout.
    ///
    /// # Errors
    /// When it is no file of the checkout there, or git fails.
    pub async fn restore_controller(&self, project: &Project, file: &str) -> Result<(), CheckoutError> {
        let refused = || CheckoutError::NoController(file.to_owned());
        let path = restored::controller(&project.place, file).ok_or_else(refused)?;
        let start = Instant::now();
        let is_there = match self.restore(project, &path).await {
            Err(error) => {
                self.mend(&project.url, start, error).await?;
                self.restore(project, &path).await?
            }
            Ok(is_there) => is_there,
        };
        if is_there { Ok(()) } else { Err(refused()) }
    }

    /// Restores a file of a project's repository. Returns whether it is there.
    async fn restore(&self, project: &Project, path: &str) -> Result<bool, CheckoutError> {
        let Project { url, revision, instance, .. } = project;
        let Some(repository) = self.finder.file(url, revision, path).await? else {
            return Ok(false);
        };
        let failed = |error| machine(url, &error);
        let restored = Restored::new(instance.path()).map_err(failed)?;
        let call = copy_call(&repository, revision, (instance, restored.path()), &What::Path(path));
        self.git.run(call, |_| ()).await.map_err(|source| git_failed(url, source))?;
        restored.place(instance.project(), path.to_owned()).await.map_err(failed)?;
        Ok(true)
    }
}
