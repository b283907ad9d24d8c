//! Brings the commits of worlds into the cache: once for all who wait for the same, and only what is new.
//!
//! A fetch is a future that all its clients share. It runs as long as one of them waits; when the last has gone it is
//! dropped, and git ends with it.

use std::collections::HashMap;
use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, Shared, WeakShared};
use tokio::runtime::Handle;
use tokio::sync::watch;

use super::checkout_error::{CheckoutError, damaged, fetch_failed, git_failed, machine, no_reference, too_large};
use super::git::{Call, Git};
use super::mirrors::{Mirrors, Remote};
use super::repository_cache::{InUse, RepositoryCache};
use super::revision::{self, Revision};
use super::world_file::NoWorld;
use crate::shared::project_url::ProjectUrl;

/// Brings commits into the cache; one for the whole server.
pub struct Fetcher {
    /// Runs git.
    pub git: Git,
    cache: RepositoryCache,
    mirrors: Mirrors,
    limits: Limits,
    runtime: Handle,
    /// What is being fetched now. An entry ends with the last client that waits for it.
    fetches: Mutex<HashMap<ProjectUrl, Fetch>>,
}

/// What a checkout may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// For all of it.
    pub time: Duration,
    /// In bytes: what is fetched, and what is checked out.
    pub size: u64,
    /// Whether any commit may be fetched by its hash, not only the newest of a branch or tag.
    pub any_commit: bool,
}

/// A world's commit in the cache.
#[derive(Debug)]
pub struct Fetched {
    /// Where it is.
    pub repository: InUse,
    /// Where it came from.
    pub remote: Remote,
    /// Its name in the cached repository.
    pub reference: String,
    /// What it is.
    pub revision: Revision,
}

#[derive(Clone)]
struct Fetch {
    progress: watch::Receiver<String>,
    result: WeakShared<FetchJob>,
}

type FetchJob = BoxFuture<'static, Result<Arc<Fetched>, CheckoutError>>;

/// Progress is told so often at most: nobody reads faster.
const BETWEEN_NEWS: Duration = Duration::from_millis(100);
/// Between two looks at how much a fetch has brought.
const BETWEEN_LOOKS: Duration = Duration::from_millis(200);

impl Fetcher {
    /// Prepares fetches into this cache.
    #[must_use]
    pub fn new(git: Git, cache: RepositoryCache, mirrors: Mirrors, limits: Limits, runtime: Handle) -> Self {
        Self { git, cache, mirrors, limits, runtime, fetches: Mutex::default() }
    }

    /// Waits for a world's commit to be in the cache, together with everybody who waits for the same.
    ///
    /// # Errors
    /// Why it can't be there.
    pub async fn fetched(
        self: &Arc<Self>,
        world: &ProjectUrl,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<Arc<Fetched>, CheckoutError> {
        let (mut result, mut news) = self.join_or_start(world);
        let mut told = Instant::now().checked_sub(BETWEEN_NEWS).unwrap_or_else(Instant::now);
        loop {
            let step = async {
                // What comes too soon waits, and only the newest of it is told.
                actix_rt::time::sleep_until((told + BETWEEN_NEWS).into()).await;
                news.changed().await.map(|()| news.borrow_and_update().clone())
            };
            tokio::select! {
                fetched = &mut result => return fetched,
                Ok(step) = step => {
                    told = Instant::now();
                    progress(step);
                }
            }
        }
    }

    fn join_or_start(self: &Arc<Self>, world: &ProjectUrl) -> (Shared<FetchJob>, watch::Receiver<String>) {
        let mut fetches = self.fetches.lock().unwrap_or_else(PoisonError::into_inner);
        fetches.retain(|_, fetch| fetch.result.upgrade().is_some_and(|result| result.peek().is_none()));
        if let Some(fetch) = fetches.get(world)
            && let Some(result) = fetch.result.upgrade()
        {
            return (result, fetch.progress.clone());
        }
        let (sender, progress) = watch::channel(String::new());
        let (this, wanted) = (Arc::clone(self), world.clone());
        // Each of those who wait has a time limit of its own; the job ends with the last of them.
        let job = async move { this.fetch(&wanted, &sender).await.map(Arc::new) };
        let result = job.boxed().shared();
        if let Some(weak) = result.downgrade() {
            fetches.insert(world.clone(), Fetch { progress: progress.clone(), result: weak });
        }
        (result, progress)
    }

    /// Finds the commit that a world's URL means, and brings it into the cache if it is new.
    async fn fetch(&self, world: &ProjectUrl, progress: &watch::Sender<String>) -> Result<Fetched, CheckoutError> {
        let remote = self.mirrors.remote(world).ok_or_else(|| CheckoutError::Forge(world.host().to_owned()))?;
        let repository = self.cache.take(&remote.location).await.map_err(|error| machine(world, &error))?;
        progress.send_replace(format!("looking for {}", world.repository()));
        match self.find(world, &remote, &repository, progress).await {
            Ok((revision, reference)) => Ok(Fetched { repository, remote, reference, revision }),
            // The remote's fault, unless it is the cache that git could not read.
            Err(CheckoutError::Git { repository: url, source })
                if repository.is_made() && !self.git.is_sound(repository.path()).await =>
            {
                Err(CheckoutError::Damaged { repository: url, source })
            }
            Err(error) => Err(error),
        }
    }

    /// The first of the commits that a URL may mean in which its world is, and its name in the cache.
    async fn find(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
        progress: &watch::Sender<String>,
    ) -> Result<(Revision, String), CheckoutError> {
        let mut missing = None;
        for revision in self.revisions(world, remote, repository).await? {
            let reference = format!("refs/fleet/{}", revision.commit);
            if !repository.has(&reference) {
                self.download(world, remote, repository, &revision, progress).await?;
            }
            let mut call = call(remote, repository.path(), revision.list_arguments(&reference));
            call.is_alone = true;
            let listing = self.git.run(call, |_| ()).await.map_err(|source| damaged(world, source))?;
            let listing = revision::Listing::parse(&listing);
            if listing.size > self.limits.size {
                return Err(too_large("The project".to_owned(), self.limits.size));
            }
            if listing.has(&revision.world_path(world)) {
                return Ok((revision, reference));
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
            // What is in the cache was accepted before.
            let known = self.limits.any_commit || repository.has(&format!("refs/fleet/{}", commit.commit));
            return if known || self.is_tip(world, remote, repository, &commit).await? {
                Ok(vec![commit])
            } else {
                Err(CheckoutError::NoTip { repository: world.repository(), commit: commit.name })
            };
        }
        let call = call(remote, repository.path(), revision::search_arguments(world, &remote.location));
        let answer = self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
        Ok(revision::found(world, &String::from_utf8_lossy(&answer)))
    }

    /// Whether a commit is the newest of a branch or tag. Forges hand out by their hash also commits of forks and of
    /// proposals, which the repository's owner never accepted: allowing a repository must not allow those.
    async fn is_tip(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
        revision: &Revision,
    ) -> Result<bool, CheckoutError> {
        let call = call(remote, repository.path(), revision::tips_arguments(&remote.location));
        let answer = self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
        Ok(revision::is_tip(&String::from_utf8_lossy(&answer), &revision.commit))
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
        let _fetching = repository.fetching().await.map_err(|error| machine(world, &error))?;
        if repository.has(&format!("refs/fleet/{}", revision.commit)) {
            return Ok(());
        }
        self.make_repository(world, remote, repository).await?;
        let call = call(remote, repository.path(), revision.fetch_arguments(&remote.location));
        let tell = |line: &str| {
            if line.contains('%') {
                let step = line.trim_start_matches("remote: ");
                progress.send_replace(format!("fetching {}: {step}", world.repository()));
            }
        };
        let mut fetch = std::pin::pin!(self.git.run(call, tell));
        let mut look = actix_rt::time::interval(BETWEEN_LOOKS);
        loop {
            tokio::select! {
                result = &mut fetch => {
                    result.map_err(|source| fetch_failed(world, revision, source))?;
                    self.shrink_soon();
                    return Ok(());
                }
                _ = look.tick() => {
                    if repository.received() > self.limits.size {
                        return Err(too_large(format!("{} (at depth 1)", world.repository()), self.limits.size));
                    }
                }
            }
        }
    }

    /// Makes the bare repository, unless it is there. It takes its place only when it is whole.
    async fn make_repository(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
    ) -> Result<(), CheckoutError> {
        if repository.is_made() {
            return Ok(());
        }
        let path = repository.path();
        let new = path.with_extension("new");
        for broken in [&new, path] {
            if broken.exists() {
                tokio::fs::remove_dir_all(broken).await.map_err(|error| machine(world, &error))?;
            }
        }
        let call = call(remote, &new, vec!["init".into(), "--quiet".into(), "--bare".into()]);
        self.git.run(call, |_| ()).await.map_err(|source| git_failed(world, source))?;
        tokio::fs::rename(&new, path).await.map_err(|error| machine(world, &error))
    }

    /// Removes the cached repository of a world if it is damaged, so that the next fetch begins anew.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn mend(&self, world: &ProjectUrl) -> io::Result<()> {
        let Some(remote) = self.mirrors.remote(world) else {
            return Ok(());
        };
        let repository = self.cache.take(&remote.location).await?;
        let _fetching = repository.fetching().await?;
        if repository.path().exists() && !self.git.is_sound(repository.path()).await {
            log::warn!("{} is damaged: it is removed and fetched anew", repository.path().display());
            tokio::fs::remove_dir_all(repository.path()).await?;
        }
        Ok(())
    }

    /// Brings the cache back into its budget. Nobody waits for that.
    pub fn shrink_soon(&self) {
        let cache = self.cache.clone();
        drop(self.runtime.spawn_blocking(move || cache.shrink()));
    }
}

/// A git command on a cached repository.
#[must_use]
pub fn call<'call>(remote: &Remote, repository: &'call Path, arguments: Vec<OsString>) -> Call<'call> {
    Call { repository, arguments, protocol: remote.protocol, is_alone: false, environment: Vec::new() }
}
