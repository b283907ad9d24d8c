//! Why a checkout failed, as text for its client. Pure.

use std::io;
use std::time::Duration;

use super::git_error::{Cause, GitError};
use super::world_file::WorldFileError;
use crate::shared::domain::ProjectUrl;

/// Why a checkout failed. The messages are for the client.
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
    #[error("{repository} has no branch, tag or commit called {reference:?}")]
    NoReference {
        /// The repository's URL.
        repository: String,
        /// The reference, as in the URL.
        reference: String,
    },
    /// The world can't be opened.
    #[error(transparent)]
    World(#[from] WorldFileError),
    /// The commit is in no branch or tag of the repository.
    #[error(
        "{commit} is in no branch or tag of {repository}. Forges also hand out commits that a repository's owner never \
         accepted; this simulation server runs them only if its administrator sets anyCommit"
    )]
    NotReachable {
        /// The repository's URL.
        repository: String,
        /// The hash of the commit.
        commit: String,
    },
    /// It exceeded its timeout.
    #[error("Fetching {repository} took longer than {seconds} seconds")]
    TooSlow {
        /// The repository's URL.
        repository: String,
        /// The limit.
        seconds: u64,
    },
    /// It exceeds the size limit.
    #[error("{what} is larger than {limit} MiB")]
    TooLarge {
        /// What is too large.
        what: String,
        /// The limit.
        limit: u64,
    },
    /// git needs more memory, or gives a longer answer, than is allowed.
    #[error("{repository} takes more memory than this simulation server allows: {source}")]
    TooMuch {
        /// The repository's URL.
        repository: String,
        /// The error of git.
        source: GitError,
    },
    /// git failed.
    #[error("{repository} can't be checked out: {source}")]
    Git {
        /// The repository's URL.
        repository: String,
        /// The error of git.
        source: GitError,
    },
    /// The cached repository is corrupt.
    #[error("{repository} can't be checked out: {source}")]
    Damaged {
        /// The repository's URL.
        repository: String,
        /// The error of git.
        source: GitError,
    },
    /// The machine failed.
    #[error("{0} can't be checked out: {1}")]
    Machine(String, String),
    /// The file to restore does not exist.
    #[error("{0:?} is no file below the project's controllers folder")]
    NoController(String),
}

impl CheckoutError {
    /// Whether it is this server's fault, so that another server may do better: its disk, its network, its processes.
    pub fn is_own(&self) -> bool {
        matches!(self, Self::Machine(..))
    }
}

/// The world's URL names nothing that is there.
pub fn no_reference(world: &ProjectUrl) -> CheckoutError {
    let reference = world.candidates().into_iter().next().map(|reading| reading.reference).unwrap_or_default();
    CheckoutError::NoReference { repository: world.repository(), reference }
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
        Cause::TooMuch => CheckoutError::TooMuch { repository, source },
        Cause::Damaged => CheckoutError::Damaged { repository, source },
        Cause::Machine => CheckoutError::Machine(repository, source.to_string()),
        Cause::Other => CheckoutError::Git { repository, source },
    }
}

/// A fetch has failed; `what` was fetched.
pub fn fetch_failed(world: &ProjectUrl, what: impl FnOnce() -> String, limit: u64, error: GitError) -> CheckoutError {
    match error {
        GitError::TooLarge => too_large(what(), limit),
        source => git_failed(world, source),
    }
}

/// The time limit has passed.
pub fn too_slow(world: &ProjectUrl, limit: Duration) -> CheckoutError {
    CheckoutError::TooSlow { repository: world.repository(), seconds: limit.as_secs() }
}

/// The size limit, in bytes, has passed.
pub fn too_large(what: String, limit: u64) -> CheckoutError {
    CheckoutError::TooLarge { what, limit: limit >> 20 }
}

/// The machine has failed.
pub fn machine(world: &ProjectUrl, error: &io::Error) -> CheckoutError {
    CheckoutError::Machine(world.repository(), error.to_string())
}
