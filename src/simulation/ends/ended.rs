//! A simulation that has ended.

use std::path::PathBuf;
use std::time::Duration;

use super::end_reason::EndReason;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::who::Who;

/// What a simulation has taken, as far as it is known.
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
    /// Of which kind it is.
    pub reason: EndReason,
    /// Why, in words, without its output.
    pub why: String,
    /// What it has taken.
    pub taken: Taken,
}

/// A simulation that has ended. Times are seconds since 1970.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Its id.
    pub id: SimulationId,
    /// When it was asked for.
    pub begin: u64,
    /// When it ended.
    pub end: u64,
    /// The address of its client.
    pub client: String,
    /// Who it is; for administrators alone.
    pub who: Who,
    /// The URL of the repository.
    pub repository: String,
    /// The URL of the world.
    pub world: String,
    /// Its port, if it was given one.
    pub port: Option<u16>,
    /// The file with its output, if it was launched.
    pub log: Option<PathBuf>,
    /// What happened to it: a line each, with the time.
    pub events: Vec<String>,
    /// How it ended.
    pub how: End,
}

impl Ended {
    /// Whether its output is kept for a while.
    #[must_use]
    pub fn has_output(&self) -> bool {
        self.log.is_some() || self.how.reason.is_abnormal()
    }
}
