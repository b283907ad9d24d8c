//! The status of the fleet, for pages and metrics. Plain data.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use crate::session::config::DnsName;
use crate::shared::domain::Load;
use crate::shared::domain::PublicAddress;
use crate::shared::domain::ServerReport;

/// Everything that is known of the fleet.
#[derive(Debug, Clone)]
pub struct FleetStatus {
    /// Whether some simulation server can take a client.
    pub available: bool,
    /// The mean load of the servers that answer.
    pub mean_load: Option<f64>,
    /// Each simulation server, in the order of the configuration; last those that no name leads to any more.
    pub servers: Vec<ServerStatus>,
    /// Each name of the configuration that is looked up.
    pub names: Vec<NameStatus>,
    /// The last changes of state, the newest first.
    pub changes: VecDeque<StateChange>,
}

/// What is known of a name that leads to simulation servers.
#[derive(Debug, Clone)]
pub struct NameStatus {
    /// The name.
    pub name: DnsName,
    /// To how many servers it leads.
    pub servers: usize,
    /// Why the last lookup failed, if it did: the servers are those that were found before.
    pub error: Option<String>,
    /// Since when lookups fail or don't.
    pub since: SystemTime,
}

/// What is known of one simulation server.
#[derive(Debug, Clone)]
pub struct ServerStatus {
    /// Its address.
    pub address: PublicAddress,
    /// Its state.
    pub state: ServerState,
    /// Since when it has been in that state.
    pub since: SystemTime,
    /// Its last report.
    pub report: Option<Arc<ServerReport>>,
    /// Why the last probe failed, if it did, or why others are preferred to it, if they are.
    pub error: Option<String>,
    /// The reported load and that of the clients it does not show yet, in percent.
    pub effective_load: Option<f64>,
    /// How many clients were sent there and have not come yet.
    pub in_flight: usize,
    /// What one more client is expected to cost, in percent of load.
    pub client_cost: Option<f64>,
    /// How long the last probe took.
    pub latency: Option<Duration>,
    /// When it last gave a good answer.
    pub answered: Option<Instant>,
}

/// The state of a simulation server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerState {
    /// It was not probed yet.
    Unknown,
    /// It takes clients.
    Up,
    /// Its load leaves no room for one more client, or it has no place left.
    Full,
    /// It takes no new clients, because it or the configuration says so.
    Draining,
    /// It gives no usable answer.
    Down,
}

/// A simulation server has changed its state, or a name that leads to some has begun to fail or works again.
#[derive(Debug, Clone)]
pub struct StateChange {
    /// When it changed.
    pub at: SystemTime,
    /// The simulation server's address, or the name.
    pub server: String,
    /// Its new state.
    pub state: ServerState,
    /// Why, in words.
    pub why: String,
}

impl ServerState {
    /// The name of the state, as pages and metrics have it.
    pub fn word(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Up => "up",
            Self::Full => "full",
            Self::Draining => "draining",
            Self::Down => "down",
        }
    }
}

/// Returns the mean load as `/load` shows it, in percent: -1 where no server answers.
pub fn displayed_mean_load(mean_load: Option<f64>) -> f64 {
    mean_load.and_then(|mean| Load::try_from(mean).ok()).map_or(-1.0, Load::percent)
}
