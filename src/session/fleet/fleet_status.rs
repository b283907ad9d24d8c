//! The status of the fleet, for pages and metrics.

use std::collections::VecDeque;

use serde::Serialize;

use super::server_record::{ServerRecord, ServerState, StateChange};

/// Everything that is known of the fleet.
#[derive(Debug, Clone)]
pub struct FleetStatus {
    /// Whether some simulation server can take a client.
    pub available: bool,
    /// The mean load of the servers that answer.
    pub mean_load: Option<f64>,
    /// Each simulation server, in the order of the configuration.
    pub servers: Vec<ServerStatus>,
    /// Each name of the configuration that is resolved.
    pub names: Vec<NameStatus>,
    /// The last changes of state, the newest first.
    pub changes: VecDeque<StateChange>,
}

impl FleetStatus {
    /// Number of simulation servers in this state.
    pub fn count(&self, state: ServerState) -> usize {
        self.servers.iter().filter(|server| server.record.state == state).count()
    }
}

/// What is known of a name that resolves to simulation servers.
#[derive(Debug, Clone, Serialize)]
pub struct NameStatus {
    /// The entry of `simulationServers`.
    pub name: String,
    /// Number of servers that it resolves to.
    pub servers: usize,
    /// Why the last lookup failed, if it did: the servers are those that were found before.
    pub error: Option<String>,
}

/// What is known of one simulation server.
#[derive(Debug, Clone)]
pub struct ServerStatus {
    /// What its probes have shown.
    pub record: ServerRecord,
    /// Why the last probe failed, if it did, or why others are preferred to it, if they are.
    pub error: Option<String>,
    /// The reported load plus that of the clients that it does not show yet, in percent.
    pub effective_load: Option<f64>,
    /// Number of clients that were sent there and have not arrived yet.
    pub in_flight: usize,
    /// Expected cost of one more client, in percent of load.
    pub client_cost: Option<f64>,
}
