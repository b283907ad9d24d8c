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
    /// The fetch exceeds the size limit.
    #[error("it is too large")]
    TooLarge,
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
    /// It exceeds git's memory limit, or the size limit of an answer.
    TooMuch,
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
const MESSAGES: &[(&str, Cause)] = &[
    ("No space left on device", Cause::Machine),
    ("Disk quota exceeded", Cause::Machine),
    ("Read-only file system", Cause::Machine),
    ("Input/output error", Cause::Machine),
    ("Too many open files", Cause::Machine),
    ("Cannot allocate memory", Cause::Machine),
    ("Resource temporarily unavailable", Cause::Machine),
    // These hosts come from the configuration: URLs with other hosts are refused before.
    ("Could not resolve host", Cause::Machine),
    ("Failed to connect to", Cause::Machine),
    ("Couldn't connect to", Cause::Machine),
    ("SSL certificate", Cause::Machine),
    ("certificate verification failed", Cause::Machine),
    ("returned error: 301", Cause::Moved),
    ("returned error: 302", Cause::Moved),
    ("returned error: 303", Cause::Moved),
    ("returned error: 307", Cause::Moved),
    ("returned error: 308", Cause::Moved),
    ("Out of memory, ", Cause::TooMuch),
    ("memory exhausted", Cause::TooMuch),
    ("could not read Username", Cause::NoRepository),
    ("not found", Cause::NoRepository),
    ("does not appear to be a git repository", Cause::NoRepository),
    ("does not exist", Cause::NoRepository),
    ("couldn't find remote ref", Cause::NoCommit),
    ("not our ref", Cause::NoCommit),
    ("unadvertised object", Cause::NoCommit),
    ("remote did not send", Cause::NoCommit),
    ("mismatched algorithms", Cause::Damaged),
    ("not a git repository", Cause::Damaged),
    ("bad config", Cause::Damaged),
    ("bad shallow", Cause::Damaged),
    ("bad object", Cause::Damaged),
    ("bad tree", Cause::Damaged),
    ("corrupt", Cause::Damaged),
    ("too short to be a packfile", Cause::Damaged),
    ("unresolved delta", Cause::Damaged),
    ("unable to read", Cause::Damaged),
    ("reference broken", Cause::Damaged),
    ("invalid reference", Cause::Damaged),
    ("did not send all necessary objects", Cause::Damaged),
    // The lock of a killed git.
    ("File exists", Cause::Damaged),
];

impl GitError {
    /// What the failure means.
    pub fn cause(&self) -> Cause {
        let message = match self {
            Self::Failed { ending: ExitReason::Code(_), message, .. } => message,
            Self::TooLong(_) => return Cause::TooMuch,
            Self::Machine(_) => return Cause::Machine,
            Self::Failed { .. } | Self::TooLarge | Self::Slow(_) => return Cause::Other,
        };
        MESSAGES.iter().find(|(words, _)| message.contains(words)).map_or(Cause::Other, |(_, cause)| *cause)
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
            ("fatal: Out of memory, malloc failed (tried to allocate 9 bytes)", Cause::TooMuch),
            ("fatal: early EOF", Cause::Other),
        ] {
            assert_eq!(cause(message, ExitReason::Code(128)), expected, "{message}");
        }
        assert_eq!(cause("fatal: bad object", ExitReason::Signal(9)), Cause::Other, "somebody has killed it");
    }
}
