//! Resolves a world's URL to a commit, and fetches it into the cache: once for all clients that wait for it.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use super::git::GitError;
use super::repository::{CheckoutError, Repository, failed};
use super::repository_cache::{COMMITS, HISTORY, RepositoryCache};
use super::revision::{self, Revision, Tip, TrustSource};
use super::single_flight::{SingleFlight, Steps};
use super::{redirect, steps};
use crate::shared::domain::{AdmissionRules, Failure, ProjectUrl, Reason};
use crate::simulation::config::{Remote, SimulationConfig};
use crate::simulation::progress::OnProgress;

/// Resolves commits; one for the whole server.
pub struct CommitResolver {
    cache: Arc<RepositoryCache>,
    config: Arc<SimulationConfig>,
    /// Limit redirects of Git hosts.
    rules: AdmissionRules,
    searches: SingleFlight<(ProjectUrl, Option<Tip>), Result<Arc<ResolvedCommit>, CheckoutError>>,
    /// The remotes to which Git hosts have redirected, by [`Remote::key`]: GitLab redirects to `REPOSITORY.git`.
    redirected: Mutex<HashMap<String, Remote>>,
}

/// A world's commit in the cache.
pub struct ResolvedCommit {
    /// The repository that contains it.
    pub repository: Arc<Repository>,
    /// The generation of the repository that contains it.
    pub generation: u64,
    /// The commit and the project's directory in it.
    pub revision: Revision,
    /// The files of the directories above the project's, each path ended by a zero byte: worlds may refer to them.
    pub above: Vec<u8>,
}

/// The search for a world's commit.
#[derive(Clone, Copy)]
struct Search<'job> {
    resolver: &'job CommitResolver,
    world: &'job ProjectUrl,
    /// The cached repository of its commits.
    repository: &'job Arc<Repository>,
    /// Receives each step.
    progress: OnProgress<'job>,
}

impl CommitResolver {
    /// Keeps commits in `cache`.
    pub fn new(cache: Arc<RepositoryCache>, config: Arc<SimulationConfig>, rules: AdmissionRules) -> Self {
        Self {
            cache,
            config,
            rules,
            searches: SingleFlight::default(),
            redirected: Mutex::default(),
        }
    }

    /// Waits until a world's commit is in the cache. Callers with the same world share one search. With a tip, which the
    /// remote has said before, it is not asked.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn resolve(
        self: &Arc<Self>,
        world: &ProjectUrl,
        tip: Option<Tip>,
        progress: OnProgress<'_>,
    ) -> Result<Arc<ResolvedCommit>, CheckoutError> {
        let this = Arc::clone(self);
        let key = (world.clone(), tip);
        let (world, tip) = key.clone();
        let search = |steps| async move { this.search(&world, tip, &steps).await.map(Arc::new) };
        self.searches.join(key, progress, search).await
    }

    /// Returns the cached repository of these worlds, which have one, and the commits that their URLs mean now. The remote
    /// is asked once, if `is_due` and there is a URL that names a branch or tag.
    ///
    /// # Errors
    /// When it can't be asked.
    pub async fn tips(
        &self,
        worlds: &[ProjectUrl],
        is_due: bool,
    ) -> Result<(Arc<Repository>, Vec<Tip>), CheckoutError> {
        let first = worlds.first().ok_or(CheckoutError::NoCommit)?;
        let repository = self.repository(first, COMMITS).await?;
        let has_name = |world: &&ProjectUrl| revision::commit_of(world, self.config.any_commit).is_none();
        let named: Vec<&ProjectUrl> = worlds.iter().filter(has_name).collect();
        let answer = if is_due && !named.is_empty() {
            repository.ask(&revision::search_arguments(named)).await?
        } else {
            String::new()
        };
        let tips = if is_due {
            let tip = |world| Tip(revision::found(world, &answer).into());
            worlds.iter().map(tip).collect()
        } else {
            Vec::new()
        };
        Ok((repository, tips))
    }

    /// The same world in the repository to which its Git host redirects.
    ///
    /// # Errors
    /// When the redirect may not be followed.
    pub fn moved(&self, world: &ProjectUrl, location: Option<&str>) -> Result<ProjectUrl, CheckoutError> {
        let (moved, remote) = redirect::follow(location, (&self.config.git_mirrors, &self.rules), world)
            .map_err(CheckoutError::Failed)?;
        self.redirected.lock().insert(remote.key(), remote);
        Ok(moved)
    }

    /// Returns the first commit that contains the world, out of those that its URL may mean.
    async fn search(
        &self,
        world: &ProjectUrl,
        tip: Option<Tip>,
        sent: &Steps,
    ) -> Result<ResolvedCommit, CheckoutError> {
        let progress = |step| sent.send(step);
        progress(steps::looking_for(&world.repository()));
        let repository = self.repository(world, COMMITS).await?;
        let revisions = match (revision::commit_of(world, self.config.any_commit), tip) {
            (Some(commit), _) => vec![commit],
            (None, Some(tip)) => tip.0.to_vec(),
            (None, None) => revision::found(world, &repository.ask(&revision::search_arguments([world])).await?),
        };
        let search = Search {
            resolver: self,
            world,
            repository: &repository,
            progress: &progress,
        };
        let mut missing = CheckoutError::NoCommit;
        for revision in revisions {
            let path = revision.path_of(&format!("worlds/{}", world.world()));
            match search.read(&revision, &path).await {
                Ok(Some((generation, above))) => {
                    return Ok(ResolvedCommit {
                        repository,
                        generation,
                        revision,
                        above,
                    });
                }
                Ok(None) => {
                    let message = format!("{path} in {} does not exist", revision.name);
                    missing = failed(Reason::WorldNotFound, message);
                }
                Err(CheckoutError::NoCommit) => {}
                Err(error) => return Err(error),
            }
        }
        Err(missing)
    }

    /// The cached repository of a world with this content.
    async fn repository(&self, world: &ProjectUrl, content: &str) -> Result<Arc<Repository>, CheckoutError> {
        let remote = self.config.git_mirrors.remote(world).ok_or_else(|| {
            let message = format!(
                "This simulation server takes worlds from github.com and from the mirrors that it is configured with, \
                 not from {}",
                world.host()
            );
            failed(Reason::RepositoryNotAllowed, message)
        })?;
        let remote = self.redirected.lock().get(&remote.key()).cloned().unwrap_or(remote);
        Ok(self.cache.repository(&remote, content).await?)
    }

    /// Checks that a file exists at a path of a commit that was found before. The commit is fetched again if it was
    /// evicted from the cache. Returns the repository and its generation if the file exists.
    ///
    /// # Errors
    /// When the commit can't be read.
    pub async fn file(
        &self,
        world: &ProjectUrl,
        revision: &Revision,
        path: &str,
    ) -> Result<Option<(Arc<Repository>, u64)>, CheckoutError> {
        let repository = self.repository(world, COMMITS).await?;
        let search = Search {
            resolver: self,
            world,
            repository: &repository,
            progress: &drop,
        };
        let found = search.read(revision, path).await?;
        Ok(found.map(|(generation, _)| (repository, generation)))
    }
}

impl Search<'_> {
    /// Fetches a commit unless it is cached. If it has a file at `path`, returns the generation of the repository that
    /// contains it, and the files of the directories above the project's, each path ended by a zero byte.
    async fn read(self, revision: &Revision, path: &str) -> Result<Option<(u64, Vec<u8>)>, CheckoutError> {
        let repository = self.repository;
        let reference = revision.reference();
        let arguments = revision.list_arguments(path);
        let mut generation = repository.generation();
        let mut listed = repository.read(&arguments).await;
        if listed.is_err()
            && repository
                .read(&["rev-parse", "--quiet", "--verify", &reference])
                .await
                .is_err()
        {
            self.fetch_commit(revision).await?;
            generation = repository.generation();
            listed = repository.read(&arguments).await;
        }
        match listed {
            Ok(answer) => Ok(revision.files_above(&answer, path).map(|above| (generation, above))),
            Err(error @ GitError::NotRun(_)) => Err(repository.unreadable(generation, error).await),
            Err(error) => {
                let kind = repository.read(&["cat-file", "-t", &format!("{reference}^{{}}")]).await;
                if kind.is_ok_and(|kind| kind.starts_with(b"blob")) {
                    Err(CheckoutError::NoCommit)
                } else {
                    Err(repository.unreadable(generation, error).await)
                }
            }
        }
    }

    /// Fetches a commit, if it is in a branch or tag or need not be.
    async fn fetch_commit(self, revision: &Revision) -> Result<(), CheckoutError> {
        let name = self.world.repository();
        if revision.trust == TrustSource::Url && !self.is_accepted(&revision.commit).await? {
            let message = format!(
                "{} is in no branch or tag of {name}. Git hosts also hand out commits that a repository's owner never \
                 accepted; this simulation server runs them only if its administrator sets anyCommit",
                revision.name
            );
            return Err(failed(Reason::CommitNotFound, message));
        }
        let fetched = self.fetch(self.repository, revision.fetch_arguments(), &name).await;
        match fetched {
            // The remote has reported the tip of a branch itself, but only the URL names this commit.
            Err(CheckoutError::NotServed(_)) if revision.trust != TrustSource::Tip => Err(CheckoutError::NoCommit),
            fetched => fetched,
        }
    }

    /// Whether a commit that is named by its hash is in a branch or tag. The history is fetched unless it is cached.
    async fn is_accepted(self, commit: &str) -> Result<bool, CheckoutError> {
        if self
            .repository
            .ask(&revision::LIST_TIPS)
            .await?
            .lines()
            .any(|tip| tip.starts_with(commit))
        {
            return Ok(true);
        }
        let history = self.resolver.repository(self.world, HISTORY).await?;
        if is_reachable(&history, commit).await? {
            return Ok(true);
        }
        let name = format!("{} with its history", self.world.repository());
        let fetched = self.fetch(&history, revision::fetch_history(), &name).await;
        fetched.map_err(of_history)?;
        is_reachable(&history, commit).await
    }

    /// Fetches into a repository. `name` is for the client.
    async fn fetch(self, into: &Arc<Repository>, arguments: Vec<String>, name: &str) -> Result<(), CheckoutError> {
        let on_line = |line: String| (self.progress)(steps::fetching(name, &line));
        into.fetch(arguments, &on_line).await
    }
}

/// Says that it is the history that is too large: the project may be small.
fn of_history(error: CheckoutError) -> CheckoutError {
    match error {
        CheckoutError::OfRepository(failure) if failure.reason == Reason::ProjectTooLarge => {
            let message = format!("with its history {}", failure.message);
            CheckoutError::OfRepository(Failure { message, ..failure })
        }
        other => other,
    }
}

/// Whether a commit is part of a branch or tag of a history.
async fn is_reachable(history: &Arc<Repository>, commit: &str) -> Result<bool, CheckoutError> {
    let generation = history.generation();
    if history.read(&["cat-file", "-e", commit]).await.is_err() {
        return Ok(false);
    }
    let branches = [
        "for-each-ref",
        "--count=1",
        "--contains",
        commit,
        "refs/heads",
        "refs/tags",
    ];
    match history.read(&branches).await {
        Ok(names) => Ok(!names.is_empty()),
        Err(error) => Err(history.unreadable(generation, error).await),
    }
}
