//! Queries of a remote for a commit, and the fetched history of its branches and tags.

use std::ffi::OsStr;
use std::sync::Arc;

use super::checkout_error::{CheckoutError, fetch_failed, git_failed, machine, no_reference, too_large};
use super::checkout_limits::CheckoutLimits;
use super::git::{Call, Git, LITTLE_MEMORY};
use super::repository::Repository;
use super::repository_cache::RepositoryCache;
use super::revision::{self, Revision};
use super::steps;
use crate::shared::domain::ProjectUrl;

/// The context of the search for a world's commit.
#[derive(Clone, Copy)]
pub struct RemoteQuery<'job> {
    /// Runs git.
    pub git: &'job Git,
    /// The cache of histories.
    pub cache: &'job RepositoryCache,
    /// The limits of a fetch.
    pub limits: &'job CheckoutLimits,
    /// The world to find.
    pub world: &'job ProjectUrl,
    /// The cached repository of its commits.
    pub repository: &'job Arc<Repository>,
    /// Receives each step as text.
    pub progress: &'job (dyn Fn(String) + Send + Sync),
}

impl RemoteQuery<'_> {
    async fn history(self) -> Result<Arc<Repository>, CheckoutError> {
        let history = self.cache.history(&self.repository.remote()).await;
        history.map_err(|error| machine(self.world, &error))
    }

    /// Fetches the commits of all branches and tags; `commit` determines the hash algorithm.
    async fn fetch_history(self, history: &Arc<Repository>, commit: &str) -> Result<(), CheckoutError> {
        let RemoteQuery { world, progress, .. } = self;
        let what = || format!("The history of {}", world.repository());
        let tell = |said: String| progress(steps::fetching(&format!("the history of {}", world.repository()), &said));
        let fetched = history.fetch(&revision::history(&history.remote().location, commit), &tell).await;
        fetched.map_err(|error| fetch_failed(world, what, self.limits.size, error))?;
        if history.packed().await > self.limits.size {
            return Err(too_large(what(), self.limits.size));
        }
        Ok(())
    }

    /// Whether a commit that is named by its hash is in a branch or tag.
    ///
    /// # Errors
    /// Why it can't be determined.
    pub async fn is_accepted(self, revision: &Revision) -> Result<bool, CheckoutError> {
        let answer = self.tips().await?;
        if revision::is_of_other_length(&answer, &revision.commit) {
            return Err(no_reference(self.world));
        }
        Ok(revision::is_tip(&answer, &revision.commit) || self.is_in_history(&revision.commit).await?)
    }

    /// Whether a commit is part of a branch or tag. Fetches the history if it is not cached.
    async fn is_in_history(self, commit: &str) -> Result<bool, CheckoutError> {
        let history = self.history().await?;
        let is_small = history.packed().await <= self.limits.size;
        if is_small && self.is_reachable(&history, commit).await? {
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

    /// All branches and tags of the remote.
    async fn tips(self) -> Result<String, CheckoutError> {
        let location = &self.repository.remote().location;
        self.answer(&["ls-remote", "--quiet", "--heads", "--tags", "--", location]).await
    }

    /// Requests from the remote the branches and tags that the world's URL may mean.
    ///
    /// # Errors
    /// When it can't answer.
    pub async fn ask(self) -> Result<String, CheckoutError> {
        self.answer(&revision::search_arguments(self.world, &self.repository.remote().location)).await
    }

    async fn answer(self, arguments: &[impl AsRef<OsStr>]) -> Result<String, CheckoutError> {
        let turn = self.repository.may_ask().await;
        let _turn = turn.map_err(|error| machine(self.world, &std::io::Error::other(error)))?;
        let call = Call { memory: LITTLE_MEMORY, ..self.repository.call(arguments) };
        let answer = self.git.run(call, |_| ()).await.map_err(|source| git_failed(self.world, source))?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    }
}
