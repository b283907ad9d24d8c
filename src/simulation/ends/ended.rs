//! A simulation that has ended.

use std::time::Duration;

use super::end_reason::EndReason;
use crate::shared::http::Peer;
use crate::simulation::snapshot::Simulation;

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
    /// What pages showed of it last.
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
    /// Whether its output is kept for a while.
    pub fn has_output(&self) -> bool {
        self.simulation.log.is_some() || self.how.reason.is_abnormal()
    }
}
