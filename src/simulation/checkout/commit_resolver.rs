//! Resolves a world's URL to a commit, and fetches it into the cache: once for all clients that wait for it.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::watch;

use super::checkout_error::{CheckoutError, fetch_failed, git_failed, machine, no_reference};
use super::checkout_limits::CheckoutLimits;
use super::git_error::GitError;
use super::mirrors::{Mirrors, Remote};
use super::redirect;
use super::repository::Repository;
use super::repository_cache::RepositoryCache;
use super::revision::{self, FetchRequest, Revision, TrustSource};
use super::single_flight::{OnProgress, SingleFlight};
use super::steps;
use super::world_file::WorldFileError;
use crate::shared::domain::{AdmissionRules, ProjectUrl};

/// Resolves commits; one for the whole server.
pub struct CommitResolver {
    cache: Arc<RepositoryCache>,
    mirrors: Mirrors,
    rules: AdmissionRules,
    limits: CheckoutLimits,
    searches: SingleFlight<ProjectUrl, Result<Arc<ResolvedCommit>, CheckoutError>>,
    /// The remotes to which Git hosts have redirected, by [`Remote::key`]: GitLab redirects to `REPOSITORY.git`.
    redirected: Mutex<HashMap<String, Remote>>,
}

/// A world's commit in the cache.
pub struct ResolvedCommit {
    /// The repository that contains it.
    pub repository: Arc<Repository>,
    /// The commit and the project's directory in it.
    pub revision: Revision,
    /// The files of the directories above the project's, each path ended by a zero byte: worlds may refer to them.
    pub above: Vec<u8>,
}

/// The search for a world's commit.
#[derive(Clone, Copy)]
struct Search<'job> {
    world: &'job ProjectUrl,
    /// The cached repository of its commits.
    repository: &'job Arc<Repository>,
    /// Receives each step as text.
    progress: OnProgress<'job>,
}

impl CommitResolver {
    /// Keeps commits in `cache`.
    pub fn new(
        cache: Arc<RepositoryCache>,
        (mirrors, rules): (Mirrors, AdmissionRules),
        limits: CheckoutLimits,
    ) -> Self {
        Self { cache, mirrors, rules, limits, searches: SingleFlight::default(), redirected: Mutex::default() }
    }

    /// Waits until a world's commit is in the cache. Callers with the same world share one search.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn resolve(
        self: &Arc<Self>,
        world: &ProjectUrl,
        progress: OnProgress<'_>,
    ) -> Result<Arc<ResolvedCommit>, CheckoutError> {
        let (this, wanted) = (Arc::clone(self), world.clone());
        let search = |sender| async move { this.search(&wanted, &sender).await.map(Arc::new) };
        self.searches.join(world.clone(), progress, search).await
    }

    /// The same world in the repository to which its Git host redirects.
    ///
    /// # Errors
    /// When the redirect may not be followed.
    pub async fn moved(&self, world: &ProjectUrl) -> Result<ProjectUrl, CheckoutError> {
        let repository = self.repository(world).await?;
        let (moved, remote) = redirect::follow(&repository, (&self.mirrors, &self.rules), world).await?;
        self.redirected.lock().insert(remote.key(), remote);
        Ok(moved)
    }

    /// Returns the first of the commits that a URL may mean that contains its world.
    async fn search(
        &self,
        world: &ProjectUrl,
        sender: &watch::Sender<String>,
    ) -> Result<ResolvedCommit, CheckoutError> {
        let progress = |step| drop(sender.send_replace(step));
        progress(steps::looking_for(&world.repository()));
        let repository = self.repository(world).await?;
        let search = Search { world, repository: &repository, progress: &progress };
        let mut missing = None;
        for revision in self.revisions(search).await? {
            let path = revision.world_path(world);
            let Some(answer) = self.read(search, &revision, &path).await? else {
                continue;
            };
            if let Some(above) = revision.files_above(&answer, &path) {
                return Ok(ResolvedCommit { repository, revision, above });
            }
            missing = Some(WorldFileError::Missing(format!("{path} in {}", revision.name)));
        }
        Err(missing.map_or_else(|| no_reference(world), CheckoutError::World))
    }

    async fn repository(&self, world: &ProjectUrl) -> Result<Arc<Repository>, CheckoutError> {
        self.cache.commits(&self.remote(world)?).await.map_err(|error| machine(world, &error))
    }

    fn remote(&self, world: &ProjectUrl) -> Result<Remote, CheckoutError> {
        let remote = self.mirrors.remote(world).ok_or_else(|| CheckoutError::Forge(world.host().to_owned()))?;
        Ok(self.redirected.lock().get(&remote.key()).cloned().unwrap_or(remote))
    }

    /// The commits that a URL may mean, the most likely first.
    async fn revisions(&self, search: Search<'_>) -> Result<Vec<Revision>, CheckoutError> {
        if let Some(commit) = revision::commit_of(search.world, self.limits.any_commit) {
            return Ok(vec![commit]);
        }
        let location = &search.repository.remote().location;
        let answer = search.ask(&revision::search_arguments(search.world, location)).await?;
        Ok(revision::found(search.world, &answer))
    }

    /// Checks that a file exists at a path of a commit that was found before. The commit is fetched again if it was
    /// evicted from the cache. Returns the repository if the file exists.
    ///
    /// # Errors
    /// When the commit can't be read.
    pub async fn file(
        &self,
        world: &ProjectUrl,
        revision: &Revision,
        path: &str,
    ) -> Result<Option<Arc<Repository>>, CheckoutError> {
        let repository = self.repository(world).await?;
        let search = Search { world, repository: &repository, progress: &drop };
        let answer = self.read(search, revision, path).await?;
        let is_file = answer.is_some_and(|answer| revision.files_above(&answer, path).is_some());
        Ok(is_file.then_some(repository))
    }

    /// Lists a path of a commit with git; the commit is fetched first if it is not in the cache. Returns `None` if the
    /// revision is a single file.
    async fn read(
        &self,
        search: Search<'_>,
        revision: &Revision,
        path: &str,
    ) -> Result<Option<Vec<u8>>, CheckoutError> {
        let Search { world, repository, .. } = search;
        let (reference, arguments) = (revision.reference(), revision.list_arguments(path));
        let mut listed = repository.read(&arguments).await;
        if matches!(listed, Err(GitError::Failed { .. }))
            && repository.read(&["rev-parse", "--quiet", "--verify", &reference]).await.is_err()
        {
            self.fetch(search, revision).await?;
            listed = repository.read(&arguments).await;
        }
        match listed {
            Ok(text) => Ok(Some(text)),
            Err(source @ GitError::Failed { .. }) => {
                let kind = repository.read(&["cat-file", "-t", &format!("{reference}^{{}}")]).await;
                let is_file = kind.is_ok_and(|kind| kind.starts_with(b"blob"));
                if is_file { Ok(None) } else { Err(CheckoutError::Damaged(world.repository(), source)) }
            }
            Err(error) => Err(git_failed(world, error)),
        }
    }

    /// Fetches a commit, if a branch or tag vouches for it or none need to.
    async fn fetch(&self, search: Search<'_>, revision: &Revision) -> Result<(), CheckoutError> {
        let Search { world, repository, .. } = search;
        let name = world.repository();
        if revision.trust == TrustSource::Url && !self.is_accepted(search, &revision.commit).await? {
            return Err(CheckoutError::NotReachable(name, revision.name.clone()));
        }
        let request = revision.request(&repository.remote().location);
        search.fetch(repository, &request, (&name, &format!("{name} (at depth 1)"))).await
    }

    /// Whether a commit that is named by its hash is in a branch or tag. The history is fetched unless it is cached.
    async fn is_accepted(&self, search: Search<'_>, commit: &str) -> Result<bool, CheckoutError> {
        let remote = search.repository.remote();
        let tips = search.ask(&["ls-remote", "--quiet", "--heads", "--tags", "--", &remote.location]).await?;
        if revision::is_tip(&tips, commit) {
            return Ok(true);
        }
        let history = self.cache.history(&remote).await.map_err(|error| machine(search.world, &error))?;
        if search.is_reachable(&history, commit).await? {
            return Ok(true);
        }
        let name = search.world.repository();
        let names = (&*format!("the history of {name}"), &*format!("The history of {name}"));
        search.fetch(&history, &revision::history(&remote.location), names).await?;
        search.is_reachable(&history, commit).await
    }

    /// Discards what is cached of a world's repository.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn discard(&self, world: &ProjectUrl) -> Result<(), CheckoutError> {
        let remote = self.remote(world)?;
        let discarded = async {
            self.cache.commits(&remote).await?.discard().await?;
            self.cache.history(&remote).await?.discard().await
        };
        discarded.await.map_err(|error| machine(world, &error))
    }
}

impl Search<'_> {
    async fn ask(self, arguments: &[impl AsRef<OsStr>]) -> Result<String, CheckoutError> {
        self.repository.ask(arguments).await.map_err(|source| git_failed(self.world, source))
    }

    /// Fetches into a repository. The first of the names is for the client's progress, the second for what is too large.
    async fn fetch(
        self,
        into: &Arc<Repository>,
        request: &FetchRequest,
        (name, whole): (&str, &str),
    ) -> Result<(), CheckoutError> {
        let on_line = |line: String| (self.progress)(steps::fetching(name, &line));
        let fetched = into.fetch(request, &on_line).await;
        fetched.map_err(|error| fetch_failed(self.world, whole, into.limits.size, error))
    }

    /// Whether a commit is part of a branch or tag of a history.
    async fn is_reachable(self, history: &Repository, commit: &str) -> Result<bool, CheckoutError> {
        if history.read(&["cat-file", "-e", commit]).await.is_err() {
            return Ok(false);
        }
        let branches = ["for-each-ref", "--count=1", "--contains", commit, "refs/heads", "refs/tags"];
        let branches = history.read(&branches).await;
        branches.map(|answer| !answer.is_empty()).map_err(|error| git_failed(self.world, error))
    }
}
