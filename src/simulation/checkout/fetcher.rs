//! Brings the commits of worlds into the cache: once for all who wait for the same, and only what is new.

use std::ffi::OsString;
use std::io;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio_util::task::AbortOnDropHandle;

use super::cached_repository::{CommitInUse, InUse};
use super::download::Downloads;
use super::errand::{Errand, call};
use super::error::{CheckoutError, damaged, git_failed, machine, no_reference, too_large};
use super::git::Git;
use super::housekeeping;
use super::limits::Limits;
use super::mirrors::{Mirrors, Remote};
use super::repository_cache::RepositoryCache;
use super::revision::{self, Listing, Revision};
use super::single_flight::Joint;
use super::world_file::NoWorld;
use crate::shared::domain::ProjectUrl;

/// Brings commits into the cache; one for the whole server.
pub struct Fetcher {
    downloads: Arc<Downloads>,
    mirrors: Mirrors,
    /// What is being fetched now.
    fetches: Joint<ProjectUrl, Result<Arc<Fetched>, CheckoutError>>,
    _housekeeping: AbortOnDropHandle<()>,
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
    _commit: Arc<CommitInUse>,
}

impl Fetcher {
    /// Prepares fetches into this cache, and keeps it tidy, on the thread whose runtime this is.
    #[must_use]
    pub fn new(git: Git, cache: RepositoryCache, mirrors: Mirrors, limits: Limits, runtime: &Handle) -> Self {
        let git = Arc::new(git);
        let housekeeping = runtime.spawn(housekeeping::keep(cache.clone(), Arc::clone(&git), limits.patience()));
        let downloads = Arc::new(Downloads::new(git, cache, limits));
        Self { downloads, mirrors, fetches: Joint::default(), _housekeeping: AbortOnDropHandle::new(housekeeping) }
    }

    /// Runs git.
    #[must_use]
    pub fn git(&self) -> &Git {
        &self.downloads.git
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
        let (this, wanted) = (Arc::clone(self), world.clone());
        let fetch = |told| async move { this.fetch(&wanted, &told).await.map(Arc::new) };
        self.fetches.join(world.clone(), progress, fetch).await
    }

    /// Finds the commit that a world's URL means, and brings it into the cache if it is new.
    async fn fetch(&self, world: &ProjectUrl, progress: &watch::Sender<String>) -> Result<Fetched, CheckoutError> {
        let remote = self.mirrors.remote(world).ok_or_else(|| CheckoutError::Forge(world.host().to_owned()))?;
        let taken = self.downloads.cache.take(&remote.location).await;
        let repository = taken.map_err(|error| machine(world, &error))?;
        progress.send_replace(format!("looking for {}", world.repository()));
        let errand = Errand { world, remote: &remote, progress };
        match self.find(errand, &repository).await {
            Ok((revision, commit)) => {
                let reference = revision.reference();
                Ok(Fetched { repository, remote, reference, revision, _commit: commit })
            }
            // The remote's fault, unless it is the cache that git could not read.
            Err(CheckoutError::Git { repository: url, source })
                if repository.is_made() && !self.downloads.examined.is_sound(repository.path()).await =>
            {
                Err(CheckoutError::Damaged { repository: url, source })
            }
            Err(error) => Err(error),
        }
    }

    /// The first of the commits that a URL may mean in which its world is.
    async fn find(
        &self,
        errand: Errand<'_>,
        repository: &InUse,
    ) -> Result<(Revision, Arc<CommitInUse>), CheckoutError> {
        let world = errand.world;
        let mut missing = None;
        for revision in self.revisions(errand, repository).await? {
            let (revision, commit) = match repository.commit(&revision.reference()) {
                Some(commit) => (revision, Arc::new(commit)),
                None => self.downloads.commit(errand, &revision).await?,
            };
            // A tag may name a file alone.
            let Some(mut listing) = self.list(world, errand.remote, repository, &revision).await? else {
                continue;
            };
            let path = revision.world_path(world);
            let mut needed = revision;
            if !listing.has_world && (listing.has_link || listing.entries == 0) {
                match self.list(world, errand.remote, repository, &needed.whole()).await {
                    Ok(Some(all)) if all.has_link => (needed, listing) = (needed.whole(), all),
                    Err(error) if listing.has_link => return Err(error),
                    _ => {}
                }
            }
            self.check(&listing)?;
            // Where a link leads is seen in the checkout.
            if listing.has_world || listing.has_link {
                return Ok((needed, commit));
            }
            missing = Some(NoWorld::Missing(format!("{path} in {}", needed.name)));
        }
        Err(missing.map_or_else(|| no_reference(world), CheckoutError::World))
    }

    /// Whether all of a commit may be checked out, not its project's folder alone.
    ///
    /// # Errors
    /// When it is too large for that.
    pub async fn check_whole(&self, world: &ProjectUrl, fetched: &Fetched) -> Result<(), CheckoutError> {
        let whole = fetched.revision.whole();
        let listing = self.list(world, &fetched.remote, &fetched.repository, &whole).await?;
        self.check(&listing.unwrap_or_default())
    }

    fn check(&self, listing: &Listing) -> Result<(), CheckoutError> {
        let limits = &self.downloads.limits;
        if listing.entries > limits.entries() {
            return Err(CheckoutError::TooMany(limits.entries()));
        }
        if listing.size > limits.size {
            return Err(too_large("The project".to_owned(), limits.size));
        }
        Ok(())
    }

    /// What is in a commit, or in the project's folder alone; nothing where it has no files, for it is one.
    async fn list(
        &self,
        world: &ProjectUrl,
        remote: &Remote,
        repository: &InUse,
        revision: &Revision,
    ) -> Result<Option<Listing>, CheckoutError> {
        let call = call(remote, repository.path(), revision.list_arguments());
        match self.git().run(call, |_| ()).await {
            Ok(answer) => Ok(Some(Listing::parse(&answer, &revision.world_path(world)))),
            Err(error) if error.is_endless() => Err(CheckoutError::TooMany(self.downloads.limits.entries())),
            Err(error)
                if error.message.contains("not a tree object") && self.is_file(remote, repository, revision).await =>
            {
                Ok(None)
            }
            Err(source) => Err(damaged(world, source)),
        }
    }

    /// Whether there are no files below a revision, for it is one.
    async fn is_file(&self, remote: &Remote, repository: &InUse, revision: &Revision) -> bool {
        let call = call(remote, repository.path(), revision.kind_arguments());
        self.git().run(call, |_| ()).await.is_ok_and(|kind| kind.starts_with(b"blob"))
    }

    /// The commits that a URL may mean, the likeliest first.
    async fn revisions(&self, errand: Errand<'_>, repository: &InUse) -> Result<Vec<Revision>, CheckoutError> {
        let Errand { world, remote, .. } = errand;
        if let Some(commit) = revision::commit_of(world, self.downloads.limits.any_commit) {
            return if self.is_accepted(errand, repository, &commit).await? {
                Ok(vec![commit])
            } else {
                Err(CheckoutError::NotReachable { repository: world.repository(), commit: commit.name })
            };
        }
        let answer = self.ask(errand, repository, revision::search_arguments(world, &remote.location)).await?;
        Ok(revision::found(world, &answer))
    }

    /// Whether a commit may run that is named by its hash. Forges hand out by their hash also commits of forks and of
    /// proposals, which the repository's owner never accepted: allowing a repository must not allow those.
    async fn is_accepted(
        &self,
        errand: Errand<'_>,
        repository: &InUse,
        revision: &Revision,
    ) -> Result<bool, CheckoutError> {
        // What is in the cache was accepted before.
        if self.downloads.limits.any_commit || repository.commit(&revision.reference()).is_some() {
            return Ok(true);
        }
        let answer = self.ask(errand, repository, revision::tips_arguments(&errand.remote.location)).await?;
        if revision::is_of_other_length(&answer, &revision.commit) {
            return Err(no_reference(errand.world));
        }
        Ok(revision::is_tip(&answer, &revision.commit)
            || self.downloads.is_in_history(errand, &revision.commit).await?)
    }

    /// Asks the remote what it has.
    async fn ask(
        &self,
        errand: Errand<'_>,
        repository: &InUse,
        arguments: Vec<OsString>,
    ) -> Result<String, CheckoutError> {
        loop {
            let call = call(errand.remote, repository.path(), arguments.clone());
            // For a folder, git's only child reads from its pipe, and ends with it. What asks over the network may hang.
            let answer = self.git().run(call, |_| ());
            match actix_rt::time::timeout(self.downloads.limits.patience(), answer).await {
                Ok(Ok(answer)) => return Ok(String::from_utf8_lossy(&answer).into_owned()),
                Ok(Err(source)) => return Err(git_failed(errand.world, source)),
                Err(_) => self.downloads.tell_silence(errand),
            }
        }
    }

    /// Removes the cached repository of a world if it is damaged, so that the next fetch begins anew.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn mend(&self, world: &ProjectUrl) -> io::Result<()> {
        match self.mirrors.remote(world) {
            Some(remote) => self.downloads.mend(&remote).await,
            None => Ok(()),
        }
    }

    /// Has the cache brought back into its budget. Nobody waits for that.
    pub fn shrink_soon(&self) {
        self.downloads.cache.grown();
    }
}
