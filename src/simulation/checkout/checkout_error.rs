//! Why a checkout failed, as text for its client. Pure.

use std::io;
use std::time::Duration;

use super::git_error::{Cause, GitError};
use super::world_file::WorldFileError;
use crate::shared::domain::ProjectUrl;

/// Why a checkout failed. The messages are for the client. Most begin with the repository's URL.
#[derive(Debug, Clone, thiserror::Error)]
pub enum CheckoutError {
    /// This Git host is not supported.
    #[error(
        "This simulation server takes worlds from github.com and from the mirrors that it is configured with, not from {0}"
    )]
    Forge(String),
    /// The repository does not exist.
    #[error("{0} does not exist or is not public")]
    NoRepository(String),
    /// Its Git host redirects to another URL.
    #[error("{0} has moved {1}")]
    Moved(String, String),
    /// The reference does not exist.
    #[error("{0} has no branch, tag or commit called {1:?}")]
    NoReference(String, String),
    /// The world can't be opened.
    #[error(transparent)]
    World(#[from] WorldFileError),
    /// The commit is in no branch or tag of the repository.
    #[error(
        "{1} is in no branch or tag of {0}. Forges also hand out commits that a repository's owner never \
         accepted; this simulation server runs them only if its administrator sets anyCommit"
    )]
    NotReachable(String, String),
    /// It exceeded its timeout.
    #[error("Fetching {0} took longer than {1} seconds")]
    TooSlow(String, u64),
    /// It exceeds the size limit.
    #[error("{0} is larger than {1} MiB")]
    TooLarge(String, u64),
    /// git failed.
    #[error("{0} can't be checked out: {1}")]
    Git(String, GitError),
    /// The cached repository is corrupt.
    #[error("{0} can't be checked out: {1}")]
    Damaged(String, GitError),
    /// The machine failed.
    #[error("{0} can't be checked out: {1}")]
    Machine(String, String),
    /// The file to restore does not exist.
    #[error("{0:?} is no file below the project's controllers folder")]
    NoController(String),
}

impl CheckoutError {
    /// Whether it is this server's fault, so that another server may do better: its disk, its network, its processes. A
    /// cached repository may look broken because of what its owner has put there, and the next start has a new one.
    pub fn is_own(&self) -> bool {
        matches!(self, Self::Machine(..))
    }
}

/// The world's URL names nothing that is there.
pub fn no_reference(world: &ProjectUrl) -> CheckoutError {
    let reference = world.candidates().into_iter().next().map(|reading| reading.reference).unwrap_or_default();
    CheckoutError::NoReference(world.repository(), reference)
}

/// A git command that works on a cached repository, or asks a remote, has failed.
pub fn git_failed(world: &ProjectUrl, source: GitError) -> CheckoutError {
    let repository = world.repository();
    if let GitError::Slow(limit) = source {
        return too_slow(world, limit);
    }
    match source.cause() {
        Cause::NoRepository => CheckoutError::NoRepository(repository),
        Cause::NoCommit => no_reference(world),
        Cause::Moved => CheckoutError::Moved(repository, "again and again".to_owned()),
        Cause::Damaged => CheckoutError::Damaged(repository, source),
        Cause::Machine => CheckoutError::Machine(repository, source.to_string()),
        Cause::TooLarge | Cause::Other => CheckoutError::Git(repository, source),
    }
}

/// A fetch has failed; `what` was fetched.
pub fn fetch_failed(world: &ProjectUrl, what: &str, limit: u64, error: GitError) -> CheckoutError {
    if error.cause() == Cause::TooLarge { too_large(what, limit) } else { git_failed(world, error) }
}

/// The time limit has passed.
pub fn too_slow(world: &ProjectUrl, limit: Duration) -> CheckoutError {
    CheckoutError::TooSlow(world.repository(), limit.as_secs())
}

/// The size limit, in bytes, has passed.
pub fn too_large(what: &str, limit: u64) -> CheckoutError {
    CheckoutError::TooLarge(what.to_owned(), limit >> 20)
}

/// The machine has failed.
pub fn machine(world: &ProjectUrl, error: &io::Error) -> CheckoutError {
    CheckoutError::Machine(world.repository(), error.to_string())
}
