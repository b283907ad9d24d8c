//! Resolves a world's URL to a commit, and fetches it into the cache: once for all clients that wait for it.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use parking_lot::Mutex;
use tokio::sync::watch;

use super::checkout_error::{CheckoutError, fetch_failed, git_failed, machine, no_reference};
use super::checkout_limits::CheckoutLimits;
use super::git_error::GitError;
use super::mirrors::{Mirrors, Remote};
use super::redirect;
use super::remote_query::RemoteQuery;
use super::repository::Repository;
use super::repository_cache::RepositoryCache;
use super::revision::{self, Revision, TrustSource};
use super::single_flight::{OnProgress, SingleFlight};
use super::steps;
use super::world_file::WorldFileError;
use crate::shared::domain::{AdmissionRules, ProjectUrl};

/// Resolves commits; one for the whole server.
#[derive(Debug)]
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
#[derive(Debug)]
pub struct ResolvedCommit {
    /// The repository that contains it.
    pub repository: Arc<Repository>,
    /// The commit and the project's directory in it.
    pub revision: Revision,
    /// The files of the directories above the project's, each path ended by a zero byte: worlds may refer to them.
    pub above: Vec<u8>,
}

/// Number of redirected remotes from which on all are dropped.
const MAX_REDIRECTED: usize = 1000;
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
        let mut redirected = self.redirected.lock();
        if redirected.len() >= MAX_REDIRECTED {
            redirected.clear();
        }
        redirected.insert(remote.key(), remote);
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
        let search = self.with(world, &repository, &progress);
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

    fn with<'job>(
        &'job self,
        world: &'job ProjectUrl,
        repository: &'job Arc<Repository>,
        progress: OnProgress<'job>,
    ) -> RemoteQuery<'job> {
        RemoteQuery { cache: &self.cache, world, repository, progress }
    }

    async fn repository(&self, world: &ProjectUrl) -> Result<Arc<Repository>, CheckoutError> {
        self.cache.commits(&self.remote(world)?).await.map_err(|error| machine(world, &error))
    }

    fn remote(&self, world: &ProjectUrl) -> Result<Remote, CheckoutError> {
        let remote = self.mirrors.remote(world).ok_or_else(|| CheckoutError::Forge(world.host().to_owned()))?;
        Ok(self.redirected.lock().get(&remote.key()).cloned().unwrap_or(remote))
    }

    /// The commits that a URL may mean, the most likely first.
    async fn revisions(&self, search: RemoteQuery<'_>) -> Result<Vec<Revision>, CheckoutError> {
        if let Some(commit) = revision::commit_of(search.world, self.limits.any_commit) {
            return Ok(vec![commit]);
        }
        let answer = search.candidates().await?;
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
        let search = self.with(world, &repository, &drop);
        let answer = self.read(search, revision, path).await?;
        let is_file = answer.is_some_and(|answer| revision.files_above(&answer, path).is_some());
        Ok(is_file.then_some(repository))
    }

    /// Lists a path of a commit with git; the commit is fetched first if it is not in the cache. Returns `None` if the
    /// revision is a single file.
    async fn read(
        &self,
        search: RemoteQuery<'_>,
        revision: &Revision,
        path: &str,
    ) -> Result<Option<Vec<u8>>, CheckoutError> {
        let RemoteQuery { world, repository, .. } = search;
        for is_fetched in [false, true] {
            match repository.read(&revision.list_arguments(path)).await {
                Ok(text) => return Ok(Some(text)),
                Err(error @ (GitError::Machine(_) | GitError::TooLong(_) | GitError::Slow(_))) => {
                    return Err(git_failed(world, error));
                }
                Err(_)
                    if repository.read(&["rev-parse", "--quiet", "--verify", &revision.reference()]).await.is_err() => {
                }
                Err(source) => {
                    let kind = repository.read(&["cat-file", "-t", &format!("{}^{{}}", revision.reference())]).await;
                    if kind.is_ok_and(|kind| kind.starts_with(b"blob")) {
                        return Ok(None);
                    }
                    return Err(CheckoutError::Damaged { repository: world.repository(), source });
                }
            }
            // It is not in the cache.
            if is_fetched {
                break;
            }
            if revision.trust == TrustSource::Url && !search.is_accepted(revision).await? {
                return Err(CheckoutError::NotReachable {
                    repository: world.repository(),
                    commit: revision.name.clone(),
                });
            }
            self.fetch(search, revision).await?;
        }
        Err(machine(world, &std::io::Error::other("the commit that was fetched is not there")))
    }

    async fn fetch(&self, search: RemoteQuery<'_>, revision: &Revision) -> Result<(), CheckoutError> {
        let RemoteQuery { world, repository, progress, .. } = search;
        let on_line = |line: String| progress(steps::fetching(&world.repository(), &line));
        let failed =
            |error| fetch_failed(world, || format!("{} (at depth 1)", world.repository()), self.limits.size, error);
        repository.fetch(&revision.request(&repository.remote().location), &on_line).await.map_err(failed)
    }

    /// Discards what is cached of a world's repository, unless it was created after `since`.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn discard(&self, world: &ProjectUrl, since: Instant) -> Result<(), CheckoutError> {
        let remote = self.remote(world)?;
        let discarded = async {
            self.cache.commits(&remote).await?.discard(since).await?;
            self.cache.history(&remote).await?.discard(since).await
        };
        discarded.await.map_err(|error| machine(world, &error))
    }
}
