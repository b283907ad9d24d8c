//! A simulation that has ended.

use std::path::PathBuf;
use std::time::Duration;

use super::end_reason::EndReason;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::simulation_id::SimulationId;

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

/// A simulation that has ended. Times are seconds since 1970.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Its id; unique.
    pub id: SimulationId,
    /// When its client requested it.
    pub begin: u64,
    /// When it ended.
    pub end: u64,
    /// The address of its client.
    pub client: String,
    /// The client's identity, only for administrators.
    pub identity: ClientIdentity,
    /// The URL of the repository.
    pub repository: String,
    /// The URL of the world.
    pub world: String,
    /// Its port, if it got one.
    pub port: Option<u16>,
    /// The file with its output, if it was launched.
    pub log: Option<PathBuf>,
    /// Its events: one line each, with the time.
    pub events: Vec<String>,
    /// Its end.
    pub how: End,
}

impl Ended {
    /// Whether its output is kept for a while.
    pub fn has_output(&self) -> bool {
        self.log.is_some() || self.how.reason.is_abnormal()
    }
}
