//! Why a request was refused, a start has failed, or a simulation has ended: one list for both servers. Pure.
//!
//! A reason is a code. Messages to clients, labels of metrics, `simulations.csv`, `/status`, mails and the advice on
//! pages derive from it. Texts that a project, Webots, git or Docker has printed decide nothing.

use std::fmt;

use serde::{Serialize, Serializer};

/// Who has to act so that the same does not happen again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Blame {
    /// The client: what it has asked for, or has done.
    User,
    /// The world's project, or the Git host that has it.
    Project,
    /// This server, its machine or its configuration.
    Server,
    /// The fleet as a whole: it has too few free slots.
    Fleet,
}

/// Whether the same request may succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Retry {
    /// Not until something is changed.
    No,
    /// At once, on the same server.
    Here,
    /// At once, on another server, which the session server chooses.
    Elsewhere,
    /// After a while.
    Later,
}

/// Defines the reasons, and derives everything from this one table.
macro_rules! reasons {
    ($(
        $(#[$group_doc:meta])+
        $group:ident { $($(#[$doc:meta])+ $name:ident = $code:literal, $blame:ident, $retry:ident;)+ }
    )+) => {
        /// Why a request was refused, a start has failed, or a simulation has ended.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum Reason {
            $($($(#[$doc])+ $name,)+)+
        }

        impl Reason {
            $($(#[$group_doc])+ pub const $group: &[Self] = &[$(Self::$name,)+];)+

            /// All reasons.
            pub const ALL: &[Self] = &[$($(Self::$name,)+)+];

            /// The header of an HTTP answer that has its code.
            pub const HEADER: &str = "Webots-Reason";

            /// The reason with this code.
            pub fn of_code(code: &str) -> Option<Self> {
                Self::ALL.iter().copied().find(|reason| reason.code() == code)
            }

            /// Its code, which stays the same in all later versions.
            pub fn code(self) -> &'static str {
                match self {
                    $($(Self::$name => $code,)+)+
                }
            }

            /// Who is to blame.
            pub fn blame(self) -> Blame {
                match self {
                    $($(Self::$name => Blame::$blame,)+)+
                }
            }

            /// Whether the same request may succeed.
            pub fn retry(self) -> Retry {
                match self {
                    $($(Self::$name => Retry::$retry,)+)+
                }
            }
        }
    };
}

reasons! {
    /// The reasons for which a request is refused.
    REFUSALS {
        /// A message that is no request of the protocol, or has wrong values.
        InvalidRequest = "invalid-request", User, No;
        /// Too many requests of one address or on one connection.
        TooManyRequests = "too-many-requests", User, Later;
        /// The URL of the world has not the form that it must have.
        InvalidWorld = "invalid-world", User, No;
        /// The repository is not one of those whose worlds may run.
        RepositoryNotAllowed = "repository-not-allowed", User, No;
        /// The repository is one of those whose worlds may not run.
        RepositoryBlocked = "repository-blocked", User, No;
        /// Worlds of other repositories run only while the load is low (`shareIdleTime`), and it is not.
        NoIdleTime = "no-idle-time", Fleet, Later;
        /// No simulation server can take a client.
        NoServerAvailable = "no-server-available", Fleet, Later;
        /// All slots of this server are taken, and as many clients wait as may.
        QueueFull = "queue-full", Fleet, Later;
        /// The client's address or user has as many slots and waits for as many as it may.
        ShareUsed = "share-used", User, Later;
        /// The pass of a client in the line is forged, or for another world or server.
        InvalidPass = "invalid-pass", User, Later;
        /// The pass was used already.
        UsedPass = "used-pass", User, Later;
        /// The pass was not used in time (`timing.pass`).
        ExpiredPass = "expired-pass", User, Later;
        /// The server takes no new clients, because it is about to end.
        Draining = "draining", Server, Elsewhere;
        /// The server can start no simulation: Webots, its display, its disk or its Docker is missing or fails.
        NotReady = "not-ready", Server, Elsewhere;
        /// Nothing can be reset: no simulation runs, or the controller's file does not exist.
        NothingToReset = "nothing-to-reset", User, No;
    }
    /// The reasons for which a simulation server gets no clients, or only if no other has room.
    SERVER_FAILURES {
        /// The simulation server does not answer a probe in time, or closes the connection.
        NoAnswer = "no-answer", Server, Elsewhere;
        /// What the simulation server answers to a probe is no report.
        InvalidAnswer = "invalid-answer", Server, Elsewhere;
        /// The last starts on the simulation server have failed by its own fault.
        StartsFail = "starts-fail", Server, Elsewhere;
    }
    /// The reasons for which a start fails.
    FAILED_STARTS {
        /// The repository does not exist, or is not public.
        RepositoryNotFound = "repository-not-found", User, No;
        /// The repository was renamed or moved.
        RepositoryMoved = "repository-moved", User, No;
        /// The repository has no such branch, tag or commit.
        CommitNotFound = "commit-not-found", User, No;
        /// The commit has no such world, or the world can't be used.
        WorldNotFound = "world-not-found", User, No;
        /// The project has more bytes or files than it may (`projectSize`).
        ProjectTooLarge = "project-too-large", Project, No;
        /// The checkout has taken longer than it may (`timing.checkout`).
        CheckoutTimeout = "checkout-timeout", Project, Later;
        /// The Git host answers with an error, or breaks off.
        RemoteFailed = "remote-failed", Project, Later;
        /// The Git host can't be reached from this server: its name, the network, or the certificate.
        RemoteUnreachable = "remote-unreachable", Server, Elsewhere;
        /// The project's `webots.yml` or another of its files can't be used.
        InvalidProject = "invalid-project", Project, No;
        /// The image of the project could not be built.
        BuildFailed = "build-failed", Project, No;
        /// The build of the project's image has taken longer than it may (`timing.build`).
        BuildTimeout = "build-timeout", Project, No;
        /// There is no image for the world's version of Webots.
        ImageNotFound = "image-not-found", Project, No;
        /// Images of other projects were being built for as long as a build may take (`timing.build`), or several builds
        /// have filled the disk of Docker, and which one is not known.
        BuildersBusy = "builders-busy", Fleet, Later;
        /// The image of the project is larger than it may be, or its build has filled the disk.
        ImageTooLarge = "image-too-large", Project, No;
        /// Webots has listened, and has ended before its world was ready.
        LoadFailed = "load-failed", Project, No;
        /// The world was not ready in time (`timing.launch`).
        LoadTimeout = "load-timeout", Project, Here;
        /// Webots, or a program that starts it, could not be started, or has ended before it listened.
        LaunchFailed = "launch-failed", Server, Elsewhere;
        /// The disk of the server is full.
        DiskFull = "disk-full", Server, Elsewhere;
        /// The Docker of the server does not answer, has stopped, or is too slow.
        DockerUnavailable = "docker-unavailable", Server, Elsewhere;
        /// An error of the server, which its log has.
        ServerFault = "server-fault", Server, Elsewhere;
    }
    /// The reasons for which a simulation ends.
    ENDS {
        /// Its client has left.
        Left = "left", User, Here;
        /// Its client was away for too long (`timing.absence`).
        Away = "away", User, Here;
        /// Nobody has opened its stream in time (`timing.arrival`).
        NoViewer = "no-viewer", User, Here;
        /// Another connection of its client has taken it over.
        TakenOver = "taken-over", User, No;
        /// Webots has ended by itself, without an error.
        Finished = "finished", Project, Here;
        /// It has reached its time limit (`timeout`).
        TimeLimit = "time-limit", User, Here;
        /// It was paused for too long (`idleTimeout`).
        Idle = "idle", User, Here;
        /// An administrator has stopped it.
        StoppedByAdministrator = "stopped-by-administrator", User, No;
        /// The server was stopped.
        ServerStopped = "server-stopped", Server, Elsewhere;
        /// Webots was ready, and has ended with an error.
        Crashed = "crashed", Project, Here;
        /// Webots has given no sign of life for too long (`hangLimit`).
        Hung = "hung", Project, Here;
        /// It has taken more memory than it may (`limits.memory`).
        MemoryLimit = "memory-limit", Project, Here;
        /// The memory of the machine has run out, and the kernel has chosen it, as a rule because it has taken most.
        OutOfMemory = "out-of-memory", Project, Later;
        /// It has written more than it may (`limits.disk`), or has grown most when the disk was full (`diskReserve`).
        DiskLimit = "disk-limit", Project, Here;
        /// The server has lost it by an error of its own.
        Lost = "lost", Server, Here;
        /// It has ended before its client came back; how is not known any more.
        Ended = "ended", User, Here;
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.code())
    }
}

impl Serialize for Reason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.code())
    }
}

/// A refusal, a failed start or an end: its reason, in words, and what others have printed about it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// The reason, from which everything follows that the servers and pages do.
    pub reason: Reason,
    /// The reason as a sentence of ours, without its full stop. It may quote names, never outputs.
    pub message: String,
    /// What the project, Webots, git or Docker has printed: shown as theirs, decides nothing.
    pub output: Option<String>,
}

impl Failure {
    /// A failure without output of others.
    pub fn new(reason: Reason, message: impl Into<String>) -> Self {
        Self {
            reason,
            message: message.into(),
            output: None,
        }
    }

    /// The message, and what others have printed, for people.
    pub fn in_full(&self) -> String {
        match &self.output {
            Some(output) => format!("{}: {output}", self.message),
            None => self.message.clone(),
        }
    }

    /// The same with what others have printed, unless that is empty.
    pub fn with_output(self, output: impl Into<String>) -> Self {
        let output = output.into();
        Self {
            output: (!output.trim().is_empty()).then_some(output),
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn each_code_is_unique_and_in_kebab_case() {
        let codes: HashSet<_> = Reason::ALL.iter().map(|reason| reason.code()).collect();
        assert_eq!(codes.len(), Reason::ALL.len());
        assert!(
            codes
                .iter()
                .all(|code| code.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'-'))
        );
    }

    #[test]
    fn only_a_fault_of_the_server_sends_a_client_elsewhere() {
        for reason in Reason::ALL {
            assert_eq!(Reason::of_code(reason.code()), Some(*reason));
            assert!(
                reason.retry() != Retry::Elsewhere || reason.blame() == Blame::Server,
                "{reason}"
            );
        }
    }
}
