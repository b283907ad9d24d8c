//! A simulation that has ended, and why: one of a small fixed set of reasons, for counters and tables.

use std::time::Duration;

use crate::shared::http::Peer;
use crate::simulation::snapshot::Simulation;

/// Why a simulation has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndReason {
    /// Its client has left, or was disconnected.
    Left,
    /// Webots has exited by itself, without an error.
    Finished,
    /// It has reached the time limit.
    TimeLimit,
    /// It was paused for too long.
    Idle,
    /// The server was stopped.
    Stopped,
    /// The administrator has stopped it.
    Administrator,
    /// Its world could not be checked out.
    NoCheckout,
    /// Webots did not become ready.
    NoWebots,
    /// Webots was ready, and has ended with an error.
    Crashed,
    /// Webots sent no heartbeat.
    Hung,
    /// It has exceeded a limit of memory or disk.
    Limit,
    /// An error of this server, its machine or its Docker.
    Fault,
}

impl EndReason {
    /// All of them, with their names in `/metrics`, in `simulations.csv` and on the monitor.
    pub const ALL: [(Self, &'static str); 12] = [
        (Self::Left, "left"),
        (Self::Finished, "finished"),
        (Self::TimeLimit, "time_limit"),
        (Self::Idle, "idle"),
        (Self::Stopped, "stopped"),
        (Self::Administrator, "administrator"),
        (Self::NoCheckout, "no_checkout"),
        (Self::NoWebots, "no_webots"),
        (Self::Crashed, "crashed"),
        (Self::Hung, "hung"),
        (Self::Limit, "limit"),
        (Self::Fault, "fault"),
    ];

    /// Its name.
    pub fn label(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(reason, _)| *reason == self)
            .map_or("", |(_, label)| label)
    }

    /// Whether the server or the client wants the end. Otherwise something has failed, or Webots has ended by itself.
    pub fn is_intended(self) -> bool {
        matches!(
            self,
            Self::Left | Self::TimeLimit | Self::Idle | Self::Stopped | Self::Administrator
        )
    }

    /// Whether an administrator may have to find its cause, so that its events are kept even without output. A failed
    /// checkout does not count.
    pub fn is_abnormal(self) -> bool {
        matches!(
            self,
            Self::NoWebots | Self::Crashed | Self::Hung | Self::Limit | Self::Fault
        )
    }
}

/// The resources that a simulation has used, as far as they are known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Taken {
    /// Its peak memory, in bytes.
    pub memory: Option<u64>,
    /// Its processor time.
    pub time: Option<Duration>,
}

/// The end of a simulation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct End {
    /// The kind of end.
    pub reason: EndReason,
    /// The reason as text, without its output.
    pub why: String,
    /// The resources that it has used.
    pub taken: Taken,
}

/// A simulation that has ended.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Its last snapshot.
    pub simulation: Simulation,
    /// Its client.
    pub client: Peer,
    /// When it ended, in seconds since 1970.
    pub at: u64,
    /// Its events: one line each, with the time.
    pub events: Vec<String>,
    /// Its end.
    pub how: End,
}

impl Ended {
    /// Whether its output and events are kept in a file.
    pub fn has_output(&self) -> bool {
        self.simulation.log.is_some() || self.how.reason.is_abnormal()
    }
}
