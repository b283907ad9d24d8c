//! Why a checkout failed: the messages of git, and the text for its client. Pure.

use std::io;
use std::time::Duration;

use crate::shared::domain::{Failure, ProjectUrl, Reason};
use crate::simulation::process::{ExitReason, RunError};

/// Why a checkout failed.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{message}")]
pub struct CheckoutError {
    /// What the failure means.
    pub(super) cause: Cause,
    message: String,
}

/// What a failure means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The project or the client's request is the cause; the message is for the client.
    Refused,
    /// The repository does not exist, or is not public.
    NoRepository,
    /// The remote does not have the commit, or does not serve it.
    NoCommit,
    /// The remote redirects to another URL.
    Moved,
    /// The pack or the answer exceeds its size limit. In a fetch, the kernel has killed the process that writes it.
    TooLarge,
    /// This timeout was exceeded.
    Slow(Duration),
    /// The cached repository is corrupt.
    Damaged,
    /// The machine or its network fails.
    Machine,
    /// Something else, mostly a failure of the remote.
    Other,
}

/// git's exit codes do not depend on the cause, so its messages must be parsed (`LC_ALL=C`). Only this table does that.
/// The first match counts. git asks for a user name if a Git host answers 'not found': Git hosts don't distinguish
/// private from missing repositories.
const MESSAGES: &[(Cause, &[&str])] = &[
    (
        Cause::Machine,
        &[
            "No space left on device",
            "Disk quota exceeded",
            "Read-only file system",
        ],
    ),
    (
        Cause::Machine,
        &["Input/output error", "Too many open files", "Cannot allocate memory"],
    ),
    // These hosts come from the configuration: URLs with other hosts are refused earlier.
    (
        Cause::Machine,
        &["Could not resolve host", "Failed to connect to", "Couldn't connect to"],
    ),
    (
        Cause::Machine,
        &[
            "SSL certificate",
            "certificate verification failed",
            "Resource temporarily unavailable",
        ],
    ),
    (Cause::Moved, &["returned error: 30"]),
    (Cause::TooLarge, &["invalid index-pack output"]),
    (
        Cause::NoRepository,
        &[
            "could not read Username",
            "not found",
            "does not appear to be a git repository",
        ],
    ),
    (Cause::NoRepository, &["does not exist"]),
    (
        Cause::NoCommit,
        &[
            "couldn't find remote ref",
            "not our ref",
            "unadvertised object",
            "remote did not send",
        ],
    ),
    (
        Cause::Damaged,
        &["not a git repository", "bad config", "bad shallow", "bad object"],
    ),
    (
        Cause::Damaged,
        &[
            "bad tree",
            "corrupt",
            "too short to be a packfile",
            "unresolved delta",
            "unable to read",
        ],
    ),
    (
        Cause::Damaged,
        &[
            "reference broken",
            "invalid reference",
            "did not send all necessary objects",
        ],
    ),
    // The lock of a killed git.
    (Cause::Damaged, &["File exists"]),
];

impl CheckoutError {
    /// A failure with this cause.
    pub(super) fn new(cause: Cause, message: impl Into<String>) -> Self {
        Self {
            cause,
            message: message.into(),
        }
    }

    /// A git command that has not ended by itself.
    pub(super) fn not_ended(command: &str, error: &RunError) -> Self {
        let cause = match error {
            RunError::NotStarted(_) => Cause::Machine,
            RunError::Slow(limit) => Cause::Slow(*limit),
            RunError::TooLong => Cause::TooLarge,
        };
        Self::new(cause, format!("git {command} {error}"))
    }

    /// A git command that exited with another code than 0, or by a signal; `said` is its message about the cause.
    pub(super) fn ended(command: &str, ending: ExitReason, said: &str) -> Self {
        let is_of =
            |words: &[&str]| matches!(ending, ExitReason::Code(_)) && words.iter().any(|words| said.contains(words));
        let known = MESSAGES.iter().find(|(_, words)| is_of(words));
        Self::new(
            known.map_or(Cause::Other, |(cause, _)| *cause),
            format!("git {command} {ending}: {said}"),
        )
    }

    /// The same as text for a client that requests this world.
    pub(super) fn about(self, world: &ProjectUrl) -> Self {
        let (repository, why) = (world.repository(), self.message);
        let message = match self.cause {
            Cause::Refused => why,
            Cause::NoRepository => format!("{repository} does not exist or is not public"),
            Cause::NoCommit => {
                let name = world
                    .candidates()
                    .into_iter()
                    .next()
                    .map(|reading| reading.reference)
                    .unwrap_or_default();
                format!("{repository} has no branch, tag or commit called {name:?}")
            }
            Cause::Moved => format!("{repository} has moved again and again"),
            Cause::Slow(limit) => format!("Fetching {repository} took longer than {} seconds", limit.as_secs()),
            _ => format!("{repository} can't be checked out: {why}"),
        };
        Self {
            cause: self.cause,
            message,
        }
    }
}

impl From<CheckoutError> for Failure {
    fn from(error: CheckoutError) -> Self {
        let reason = match error.cause {
            Cause::Refused => Reason::WorldNotFound,
            Cause::NoRepository => Reason::RepositoryNotFound,
            Cause::NoCommit => Reason::CommitNotFound,
            Cause::Moved => Reason::RepositoryMoved,
            Cause::TooLarge => Reason::ProjectTooLarge,
            Cause::Slow(_) => Reason::CheckoutTimeout,
            Cause::Damaged | Cause::Other => Reason::RemoteFailed,
            Cause::Machine => Reason::ServerFault,
        };
        Self::new(reason, error.message)
    }
}

/// An error with the cause [`Cause::Refused`].
pub fn refused(message: impl Into<String>) -> CheckoutError {
    CheckoutError::new(Cause::Refused, message)
}

impl From<io::Error> for CheckoutError {
    fn from(error: io::Error) -> Self {
        Self::new(Cause::Machine, error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_are_told_apart() {
        let cause = |message: &str, ending| CheckoutError::ended("fetch", ending, message).cause;
        for (message, expected) in [
            (
                "fatal: repository 'https://github.com/lab/none.git/' not found",
                Cause::NoRepository,
            ),
            (
                "fatal: repository 'https://github.com/lab/certificates.git/' not found",
                Cause::NoRepository,
            ),
            (
                "fatal: unable to access 'https://a.forge/': SSL certificate problem: self-signed certificate",
                Cause::Machine,
            ),
            (
                "fatal: could not read Username for 'https://github.com': terminal prompts disabled",
                Cause::NoRepository,
            ),
            ("fatal: remote error: upload-pack: not our ref 0123", Cause::NoCommit),
            (
                "fatal: packed object 9ed5 (stored in pack-1115.pack) is corrupt",
                Cause::Damaged,
            ),
            (
                "error: cannot lock ref 'refs/fleet/01': Unable to create '01.lock': File exists.",
                Cause::Damaged,
            ),
            (
                "error: unable to create file a: No space left on device",
                Cause::Machine,
            ),
            (
                "fatal: unable to access 'https://a.forge/': Could not resolve host: a.forge",
                Cause::Machine,
            ),
            ("fatal: fetch-pack: invalid index-pack output", Cause::TooLarge),
            ("fatal: early EOF", Cause::Other),
        ] {
            assert_eq!(cause(message, ExitReason::Code(128)), expected, "{message}");
        }
        assert_eq!(
            cause("fatal: bad object", ExitReason::Signal(9)),
            Cause::Other,
            "somebody has killed it"
        );
    }
}
