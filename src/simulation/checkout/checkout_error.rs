//! Why a checkout failed, as text for its client. Pure.

use std::fmt::Display;
use std::io;
use std::time::Duration;

use super::git_error::{Cause, GitError};
use crate::shared::domain::ProjectUrl;

/// Why a checkout failed. The message is for the client. Most begin with the repository's URL.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{message}")]
pub struct CheckoutError {
    /// What the failure means.
    pub(super) cause: Cause,
    message: String,
}

impl CheckoutError {
    /// Whether it is this server's fault, so that another server may do better: its disk, its network, its processes. A
    /// cached repository may look broken because of what its owner has put there, and the next start has a new one.
    pub fn is_own(&self) -> bool {
        self.cause == Cause::Machine
    }
}

/// The project, or what the client asks for, is the cause.
pub fn refused(message: impl Into<String>) -> CheckoutError {
    CheckoutError { cause: Cause::Other, message: message.into() }
}

/// The world's URL names nothing that is there.
pub fn no_reference(world: &ProjectUrl) -> CheckoutError {
    let reference = world.candidates().into_iter().next().map(|reading| reading.reference).unwrap_or_default();
    refused(format!("{} has no branch, tag or commit called {reference:?}", world.repository()))
}

/// The commit is in no branch or tag of the repository.
pub fn not_reachable(repository: &str, name: &str) -> CheckoutError {
    refused(format!(
        "{name} is in no branch or tag of {repository}. Forges also hand out commits that a repository's owner never \
         accepted; this simulation server runs them only if its administrator sets anyCommit"
    ))
}

/// A git command that works on a cached repository, or asks a remote, has failed.
pub fn git_failed(world: &ProjectUrl, source: &GitError) -> CheckoutError {
    match source.cause {
        Cause::NoRepository => refused(format!("{} does not exist or is not public", world.repository())),
        Cause::NoCommit => no_reference(world),
        Cause::Moved => moved(world, "again and again"),
        Cause::Slow(limit) => too_slow(world, limit),
        cause => failed(world, cause, source),
    }
}

/// git can't read what is in the cache.
pub fn damaged(world: &ProjectUrl, source: &GitError) -> CheckoutError {
    match source.cause {
        Cause::Machine | Cause::Slow(_) | Cause::TooLarge => git_failed(world, source),
        _ => failed(world, Cause::Damaged, source),
    }
}

/// The time limit has passed.
pub fn too_slow(world: &ProjectUrl, limit: Duration) -> CheckoutError {
    refused(format!("Fetching {} took longer than {} seconds", world.repository(), limit.as_secs()))
}

/// The size limit, in MiB, has passed.
pub fn too_large(what: &str, limit: u64) -> CheckoutError {
    refused(format!("{what} is larger than {limit} MiB"))
}

/// Its Git host redirects, in this way.
pub fn moved(world: &ProjectUrl, how: &str) -> CheckoutError {
    CheckoutError { cause: Cause::Moved, message: format!("{} has moved {how}", world.repository()) }
}

/// The machine has failed.
pub fn machine(world: &ProjectUrl, error: &io::Error) -> CheckoutError {
    failed(world, Cause::Machine, error)
}

fn failed(world: &ProjectUrl, cause: Cause, why: impl Display) -> CheckoutError {
    CheckoutError { cause, message: format!("{} can't be checked out: {why}", world.repository()) }
}
