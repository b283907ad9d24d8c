//! A simulation that has ended, and why.

use std::time::Duration;

use crate::shared::domain::{Blame, Failure, Reason};
use crate::shared::http::Peer;
use crate::simulation::snapshot::Simulation;

/// The resources that a simulation has used, as far as they are known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ResourceUsage {
    /// Its peak memory, in bytes.
    pub memory: Option<u64>,
    /// Its processor time.
    pub time: Option<Duration>,
}

/// The end of a simulation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct End {
    /// Why it has ended.
    pub failure: Failure,
    /// The resources that it has used.
    pub taken: ResourceUsage,
}

/// A simulation that has ended.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Its last snapshot.
    pub simulation: Simulation,
    /// Its client; `None` if it was kept ready and never had one.
    pub client: Option<Peer>,
    /// When it ended, in seconds since 1970.
    pub at: u64,
    /// Its events: one line each, with the time.
    pub events: Vec<String>,
    /// Its end.
    pub end: End,
}

impl From<Failure> for End {
    /// An end that has used nothing, because Webots was not started.
    fn from(failure: Failure) -> Self {
        Self {
            failure,
            taken: ResourceUsage::default(),
        }
    }
}

impl Ended {
    /// Whether somebody may have to find its cause, so that its events are kept even without output: it has not ended as
    /// its client or an administrator wanted.
    pub fn is_abnormal(&self) -> bool {
        let reason = self.end.failure.reason;
        matches!(reason.blame(), Blame::Project | Blame::Server)
            && !matches!(reason, Reason::Finished | Reason::ServerStopped)
    }

    /// Whether its output and events are kept in a file.
    pub fn has_output(&self) -> bool {
        self.client.is_some() && self.simulation.log.is_some() || self.is_abnormal()
    }
}
