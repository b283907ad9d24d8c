//! Queries of a remote for a commit, and the fetched history of its branches and tags.

use std::ffi::OsStr;
use std::sync::Arc;

use super::checkout_error::{CheckoutError, fetch_failed, git_failed, machine, no_reference};
use super::repository::Repository;
use super::repository_cache::RepositoryCache;
use super::revision::{self, Revision};
use super::single_flight::OnProgress;
use super::steps;
use crate::shared::domain::ProjectUrl;

/// The search for a world's commit.
#[derive(Clone, Copy)]
pub struct RemoteQuery<'job> {
    /// The cache of histories.
    pub cache: &'job RepositoryCache,
    /// The world to find.
    pub world: &'job ProjectUrl,
    /// The cached repository of its commits.
    pub repository: &'job Arc<Repository>,
    /// Receives each step as text.
    pub progress: OnProgress<'job>,
}

impl RemoteQuery<'_> {
    async fn history(self) -> Result<Arc<Repository>, CheckoutError> {
        let history = self.cache.history(&self.repository.remote()).await;
        history.map_err(|error| machine(self.world, &error))
    }

    /// Fetches the commits of all branches and tags; `commit` determines the hash algorithm.
    async fn fetch_history(self, history: &Arc<Repository>, commit: &str) -> Result<(), CheckoutError> {
        let (RemoteQuery { world, progress, .. }, limit) = (self, history.limits.size);
        let what = || format!("The history of {}", world.repository());
        let on_line =
            |line: String| progress(steps::fetching(&format!("the history of {}", world.repository()), &line));
        let fetched = history.fetch(&revision::history(&history.remote().location, commit), &on_line).await;
        fetched.map_err(|error| fetch_failed(world, what, limit, error))
    }

    /// Whether a commit that is named by its hash is in a branch or tag.
    ///
    /// # Errors
    /// Why it can't be determined.
    pub async fn is_accepted(self, revision: &Revision) -> Result<bool, CheckoutError> {
        let location = &self.repository.remote().location;
        let answer = self.ask(&["ls-remote", "--quiet", "--heads", "--tags", "--", location]).await?;
        if revision::is_of_other_length(&answer, &revision.commit) {
            return Err(no_reference(self.world));
        }
        Ok(revision::is_tip(&answer, &revision.commit) || self.is_in_history(&revision.commit).await?)
    }

    /// Whether a commit is part of a branch or tag. Fetches the history if it is not cached.
    async fn is_in_history(self, commit: &str) -> Result<bool, CheckoutError> {
        let history = self.history().await?;
        if self.is_reachable(&history, commit).await? {
            return Ok(true);
        }
        self.fetch_history(&history, commit).await?;
        self.is_reachable(&history, commit).await
    }

    async fn is_reachable(self, history: &Repository, commit: &str) -> Result<bool, CheckoutError> {
        if history.read(&["cat-file", "-e", commit]).await.is_err() {
            return Ok(false);
        }
        let branches = ["for-each-ref", "--count=1", "--contains", commit, "refs/heads", "refs/tags"];
        let branches = history.read(&branches).await;
        branches.map(|answer| !answer.is_empty()).map_err(|error| git_failed(self.world, error))
    }

    /// Requests from the remote the branches and tags that the world's URL may mean.
    ///
    /// # Errors
    /// When it can't answer.
    pub async fn candidates(self) -> Result<String, CheckoutError> {
        self.ask(&revision::search_arguments(self.world, &self.repository.remote().location)).await
    }

    async fn ask(self, arguments: &[impl AsRef<OsStr>]) -> Result<String, CheckoutError> {
        self.repository.ask(arguments).await.map_err(|source| git_failed(self.world, source))
    }
}
