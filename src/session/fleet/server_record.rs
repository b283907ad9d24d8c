//! What the registry knows of one simulation server, and which of its changes are mailed. Part of the registry.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use serde::Serialize;

use crate::session::mail::NoticeKind;
use crate::shared::domain::{ProjectUrl, PublicAddress, ServerReport};
use crate::shared::run::timestamp;

/// The state of a simulation server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ServerState {
    /// Its last probe failed.
    Down,
    /// It was not probed yet.
    Unknown,
    /// It accepts no new clients: it drains itself, or the configuration drains it.
    Draining,
    /// Its load leaves no room for one more client, or it has no free slot.
    Full,
    /// It accepts clients.
    Up,
}

/// One simulation server.
#[derive(Debug, Clone)]
pub struct ServerRecord {
    /// Its address; unique in the fleet.
    pub address: PublicAddress,
    /// Whether it is listed in `drainedServers`.
    pub drained: bool,
    /// Its state, as of its last probe.
    pub state: ServerState,
    /// When it entered that state, as text.
    pub since: String,
    /// Its last report; kept when it is down.
    pub report: Option<Arc<ServerReport>>,
    /// The last error; kept after the server has answered again.
    pub last_error: Option<String>,
    /// Duration of the last probe.
    pub latency: Option<Duration>,
    /// Time of its last valid answer.
    pub answered: Option<Instant>,
}

/// A simulation server has changed its state.
#[derive(Debug, Clone, Serialize)]
pub struct StateChange {
    /// When it changed, as text.
    pub at: String,
    /// The simulation server's address.
    pub server: String,
    /// Its new state.
    pub state: ServerState,
    /// The reason, as text.
    pub why: String,
}

/// A change of a server's state, and the notice of it to the administrator, if any.
pub type ServerChange = (StateChange, Option<NoticeKind>);

impl ServerState {
    /// The name of the state in pages and metrics.
    pub fn word(self) -> String {
        format!("{self:?}").to_lowercase()
    }
}

impl ServerRecord {
    /// A server that was not probed yet.
    pub fn new(address: PublicAddress) -> Self {
        Self {
            address,
            drained: false,
            state: ServerState::Unknown,
            since: timestamp(SystemTime::now()),
            report: None,
            last_error: None,
            latency: None,
            answered: None,
        }
    }

    /// Records a report that arrived at this time. From a load of `limit` percent the server counts as full. Returns
    /// what has changed.
    pub fn succeeded(&mut self, report: Arc<ServerReport>, at: Instant, limit: f64) -> Option<ServerChange> {
        let load = report.load.percent();
        let full = report
            .instances
            .filter(|instances| instances.present() >= instances.places);
        let (state, reason) = if self.drained {
            (ServerState::Draining, " (drained by drainedServers)".to_owned())
        } else if report.draining {
            (ServerState::Draining, " (it drains itself)".to_owned())
        } else if let Some(full) = full {
            (
                ServerState::Full,
                format!(", {} clients in {} places", full.present(), full.places),
            )
        } else if load >= limit {
            (ServerState::Full, format!(" of {limit:.1} %"))
        } else {
            (ServerState::Up, String::new())
        };
        (self.report, self.answered) = (Some(report), Some(at));
        self.enter(state, || format!("load {load:.1} %{reason}"))
    }

    /// Records that a probe has failed. Returns what has changed.
    pub fn failed(&mut self, error: String) -> Option<ServerChange> {
        self.last_error = Some(error.clone());
        self.enter(ServerState::Down, || error)
    }

    /// Why the last probe failed, if it did.
    pub fn error(&self) -> Option<&str> {
        self.last_error.as_deref().filter(|_| self.state == ServerState::Down)
    }

    /// The last report, unless the server is down.
    pub fn current(&self) -> Option<&ServerReport> {
        self.report.as_deref().filter(|_| self.state != ServerState::Down)
    }

    /// Whether the server accepts a world, by its last report; `None` if it never answered.
    pub fn accepts(&self, world: &ProjectUrl) -> Option<bool> {
        self.report.as_ref().map(|report| report.accepts(world))
    }

    fn enter(&mut self, state: ServerState, why: impl FnOnce() -> String) -> Option<ServerChange> {
        let before = std::mem::replace(&mut self.state, state);
        if before == state {
            return None;
        }
        self.since = timestamp(SystemTime::now());
        let change = StateChange {
            at: self.since.clone(),
            server: self.address.to_string(),
            state,
            why: why(),
        };
        // The four events of the original.
        let event = match (before, state) {
            (_, ServerState::Down) => Some(NoticeKind::NotResponding),
            (ServerState::Down, _) => Some(NoticeKind::WorkingAgain),
            (_, ServerState::Full) => Some(NoticeKind::MaximumLoad),
            (ServerState::Full, ServerState::Up) => Some(NoticeKind::AvailableAgain),
            _ => None,
        };
        Some((change, event))
    }
}

/// Whether some server refuses a world, no other accepts it, and all have been probed. A server that has never answered
/// does not count, because it may never answer.
pub fn is_refused<'a>(servers: impl Iterator<Item = &'a ServerRecord>, world: &ProjectUrl) -> bool {
    let mut refused = false;
    for server in servers {
        match server.accepts(world) {
            Some(true) => return false,
            Some(false) => refused = true,
            None if server.state == ServerState::Unknown => return false,
            None => {}
        }
    }
    refused
}

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
        self.servers
            .iter()
            .filter(|server| server.record.state == state)
            .count()
    }
}

/// What is known of a name that resolves to simulation servers.
#[derive(Debug, Clone, Serialize)]
pub struct NameStatus {
    /// The entry of `simulationServers`.
    pub name: String,
    /// Number of servers that it resolves to.
    pub servers: usize,
    /// Why the last lookup failed, if it did; then the servers found before stay.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::Load;

    fn report(load: f64) -> ServerReport {
        ServerReport::load_only(Load::try_from(load).unwrap())
    }

    /// The notice after each step, if any. A step is a load, or `None` for a failure.
    fn events(steps: &[Option<f64>]) -> Vec<Option<NoticeKind>> {
        let mut record = ServerRecord::new("host:2000".parse().unwrap());
        let change = |step: &Option<f64>| match step {
            Some(load) => record.succeeded(Arc::new(report(*load)), Instant::now(), 95.0),
            None => record.failed(String::new()),
        };
        steps
            .iter()
            .map(change)
            .map(|change| change.and_then(|(_, event)| event))
            .collect()
    }

    #[test]
    fn the_administrator_hears_of_four_events() {
        use NoticeKind::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};
        assert_eq!(
            events(&[Some(1.0), Some(2.0)]),
            [None, None],
            "a server that is well is no news"
        );
        assert_eq!(
            events(&[None, None, Some(1.0)]),
            [Some(NotResponding), None, Some(WorkingAgain)]
        );
        assert_eq!(
            events(&[Some(95.0), Some(99.0), Some(94.9)]),
            [Some(MaximumLoad), None, Some(AvailableAgain)]
        );
        assert_eq!(
            events(&[None, Some(96.0), Some(1.0)]),
            [Some(NotResponding), Some(WorkingAgain), Some(AvailableAgain)]
        );
        assert_eq!(
            events(&[Some(96.0), None, Some(1.0)]),
            [Some(MaximumLoad), Some(NotResponding), Some(WorkingAgain)]
        );
    }
}
