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
    /// It ended with another exit code than 0, or by a signal.
    #[error("git {command} {ending}: {message}")]
    Failed {
        /// Which command.
        command: String,
        /// How it ended.
        ending: ExitReason,
        /// What it said of the cause.
        message: String,
    },
    /// It answered more than is read.
    #[error("the answer of git {0} is too long")]
    TooLong(String),
    /// It has brought more than may come.
    #[error("it is too large")]
    TooLarge,
    /// It took too long.
    #[error("git did not end within {} seconds", .0.as_secs())]
    Slow(Duration),
}

impl From<io::Error> for GitError {
    fn from(error: io::Error) -> Self {
        Self::Machine(error.to_string())
    }
}

/// What a failure means for whoever wanted the command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The remote has no such repository, or shows it to nobody.
    NoRepository,
    /// The remote does not hand out the commit.
    NoCommit,
    /// The remote sends elsewhere.
    Moved,
    /// It takes more memory than git may have, or more than is read of its answer.
    TooMuch,
    /// The cached repository is broken.
    Damaged,
    /// The machine or its network fails.
    Machine,
    /// Something else: most of all the remote.
    Other,
}

/// git ends with the same exit codes whatever the cause is, so its words must tell (`LC_ALL=C`). This is the only place
/// that reads them. The first that is found counts. git asks for a user's name where a forge says 'not found': forges
/// don't tell private from missing.
const MESSAGES: &[(&str, Cause)] = &[
    ("No space left on device", Cause::Machine),
    ("Disk quota exceeded", Cause::Machine),
    ("Read-only file system", Cause::Machine),
    ("Input/output error", Cause::Machine),
    ("Too many open files", Cause::Machine),
    ("Cannot allocate memory", Cause::Machine),
    ("Resource temporarily unavailable", Cause::Machine),
    // Hosts are those of the configuration: a URL with another one does not come so far.
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
    // A lock that a killed git has left.
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
