//! Why a git command failed. Pure.

use std::io;
use std::time::Duration;

use crate::simulation::process::ExitReason;

/// A git command that failed.
#[derive(Debug, Clone, thiserror::Error)]
pub enum GitError {
    /// The machine can't run git.
    #[error("{0}")]
    Machine(String),
    /// It exited with another code than 0, or by a signal.
    #[error("git {command} {ending}: {message}")]
    Failed {
        /// The git command, such as `fetch`.
        command: String,
        /// Its exit code or signal.
        ending: ExitReason,
        /// Its message about the cause.
        message: String,
    },
    /// Its answer exceeds the size limit.
    #[error("the answer of git {0} is too long")]
    TooLong(String),
    /// It exceeded its timeout.
    #[error("git did not end within {} seconds", .0.as_secs())]
    Slow(Duration),
}

impl From<io::Error> for GitError {
    fn from(error: io::Error) -> Self {
        Self::Machine(error.to_string())
    }
}

/// What a failure means for the caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The repository does not exist, or is not public.
    NoRepository,
    /// The remote does not have the commit, or does not serve it.
    NoCommit,
    /// The remote redirects to another URL.
    Moved,
    /// The fetch exceeds the size limit: the kernel has ended the program that writes its pack.
    TooLarge,
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
        &["No space left on device", "Disk quota exceeded", "Read-only file system", "Input/output error"],
    ),
    (Cause::Machine, &["Too many open files", "Cannot allocate memory", "Resource temporarily unavailable"]),
    // These hosts come from the configuration: URLs with other hosts are refused before.
    (Cause::Machine, &["Could not resolve host", "Failed to connect to", "Couldn't connect to"]),
    (Cause::Machine, &["SSL certificate", "certificate verification failed"]),
    (Cause::Moved, &["returned error: 301", "returned error: 302", "returned error: 303"]),
    (Cause::Moved, &["returned error: 307", "returned error: 308"]),
    (Cause::TooLarge, &["invalid index-pack output"]),
    (Cause::NoRepository, &["could not read Username", "not found", "does not appear to be a git repository"]),
    (Cause::NoRepository, &["does not exist"]),
    (Cause::NoCommit, &["couldn't find remote ref", "not our ref", "unadvertised object", "remote did not send"]),
    (Cause::Damaged, &["not a git repository", "bad config", "bad shallow", "bad object"]),
    (Cause::Damaged, &["bad tree", "corrupt", "too short to be a packfile", "unresolved delta", "unable to read"]),
    (Cause::Damaged, &["reference broken", "invalid reference", "did not send all necessary objects"]),
    // The lock of a killed git.
    (Cause::Damaged, &["File exists"]),
];

impl GitError {
    /// What the failure means.
    pub fn cause(&self) -> Cause {
        let message = match self {
            Self::Failed { ending: ExitReason::Code(_), message, .. } => message,
            Self::Machine(_) => return Cause::Machine,
            Self::Failed { .. } | Self::TooLong(_) | Self::Slow(_) => return Cause::Other,
        };
        let is_of = |words: &[&str]| words.iter().any(|words| message.contains(words));
        MESSAGES.iter().find(|(_, words)| is_of(words)).map_or(Cause::Other, |(cause, _)| *cause)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_are_told_apart() {
        let cause = |message: &str, ending| {
            GitError::Failed { command: "fetch".to_owned(), ending, message: message.to_owned() }.cause()
        };
        for (message, expected) in [
            ("fatal: repository 'https://github.com/lab/none.git/' not found", Cause::NoRepository),
            ("fatal: repository 'https://github.com/lab/certificates.git/' not found", Cause::NoRepository),
            (
                "fatal: unable to access 'https://a.forge/': SSL certificate problem: self-signed certificate",
                Cause::Machine,
            ),
            ("fatal: could not read Username for 'https://github.com': terminal prompts disabled", Cause::NoRepository),
            ("fatal: remote error: upload-pack: not our ref 0123", Cause::NoCommit),
            ("fatal: packed object 9ed5 (stored in pack-1115.pack) is corrupt", Cause::Damaged),
            ("error: cannot lock ref 'refs/fleet/01': Unable to create '01.lock': File exists.", Cause::Damaged),
            ("error: unable to create file a: No space left on device", Cause::Machine),
            ("fatal: unable to access 'https://a.forge/': Could not resolve host: a.forge", Cause::Machine),
            ("fatal: fetch-pack: invalid index-pack output", Cause::TooLarge),
            ("fatal: early EOF", Cause::Other),
        ] {
            assert_eq!(cause(message, ExitReason::Code(128)), expected, "{message}");
        }
        assert_eq!(cause("fatal: bad object", ExitReason::Signal(9)), Cause::Other, "somebody has killed it");
    }
}
