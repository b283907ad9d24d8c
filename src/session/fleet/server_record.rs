//! What the registry knows of one simulation server, and what its changes mean. Part of the registry.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use serde::Serialize;

use super::server_monitor::ProbeError;
use crate::session::mail::NoticeKind;
use crate::shared::domain::{ProjectUrl, PublicAddress, ServerReport};
use crate::shared::run::serialize_timestamp;

/// The state of a simulation server. Those that need attention come first, as on the monitor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ServerState {
    /// Its last probe failed.
    Down,
    /// It was not probed yet.
    Unknown,
    /// It accepts no new clients: it drains itself, the configuration drains it, or no name resolves to it any more.
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
    /// Whether no name resolves to it any more.
    pub unlisted: bool,
    /// Its state, as of its last probe.
    pub state: ServerState,
    /// When it entered that state.
    pub since: SystemTime,
    /// Its last report; kept when it is down.
    pub report: Option<Arc<ServerReport>>,
    /// The last error; kept after the server has answered again.
    pub last_error: Option<ProbeError>,
    /// Duration of the last probe.
    pub latency: Option<Duration>,
    /// Time of its last valid answer.
    pub answered: Option<Instant>,
    /// Whether the last mail about its load said that it is full.
    pub told_full: bool,
}

/// A simulation server has changed its state, or lookups of a name have begun to fail or to succeed.
#[derive(Debug, Clone, Serialize)]
pub struct StateChange {
    /// When it changed.
    #[serde(serialize_with = "serialize_timestamp")]
    pub at: SystemTime,
    /// The simulation server's address, or the name.
    pub server: String,
    /// Its new state.
    pub state: ServerState,
    /// The reason, as text.
    pub why: String,
}

/// A change of a server's state, and what is mailed to the administrator.
pub type ServerChange = (StateChange, Vec<NoticeKind>);

impl ServerState {
    /// The name of the state in pages and metrics.
    pub fn word(self) -> String {
        format!("{self:?}").to_lowercase()
    }
}

impl ServerRecord {
    /// A server that was not probed yet.
    pub fn new(address: PublicAddress, drained: bool) -> Self {
        Self {
            address,
            drained,
            unlisted: false,
            state: ServerState::Unknown,
            since: SystemTime::now(),
            report: None,
            last_error: None,
            latency: None,
            answered: None,
            told_full: false,
        }
    }

    /// Records a report that arrived at this time; the server counts as full from the load `limit` on, in percent.
    /// Returns what has changed.
    pub fn succeeded(&mut self, report: Arc<ServerReport>, at: Instant, limit: f64) -> Option<ServerChange> {
        let load = report.load.percent();
        let full = report.instances.filter(|instances| instances.present() >= instances.places);
        let (state, reason) = if self.drained {
            (ServerState::Draining, " (drained by drainedServers)".to_owned())
        } else if self.unlisted {
            (ServerState::Draining, " (no name leads to it any more)".to_owned())
        } else if report.draining {
            (ServerState::Draining, " (it drains itself)".to_owned())
        } else if let Some(full) = full {
            (ServerState::Full, format!(", {} clients in {} places", full.present(), full.places))
        } else if load >= limit {
            (ServerState::Full, format!(" of {limit:.1} %"))
        } else {
            (ServerState::Up, String::new())
        };
        (self.report, self.answered) = (Some(report), Some(at));
        self.enter(state, || format!("load {load:.1} %{reason}"))
    }

    /// Records that a probe has failed. Returns what has changed.
    pub fn failed(&mut self, error: ProbeError) -> Option<ServerChange> {
        let why = error.to_string();
        self.last_error = Some(error);
        self.enter(ServerState::Down, || why)
    }

    /// Why the last probe failed, if it did.
    pub fn error(&self) -> Option<&ProbeError> {
        self.last_error.as_ref().filter(|_| self.state == ServerState::Down)
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
        self.since = SystemTime::now();
        let change = StateChange { at: self.since, server: self.address.to_string(), state, why: why() };
        Some((change, self.events(before)))
    }

    /// The four events of the original. A server that was full, then down, then up is both working again and available
    /// again.
    fn events(&mut self, before: ServerState) -> Vec<NoticeKind> {
        let mut events = Vec::new();
        match (before, self.state) {
            (_, ServerState::Down) => events.push(NoticeKind::NotResponding),
            (ServerState::Down, _) => events.push(NoticeKind::WorkingAgain),
            _ => {}
        }
        if self.state == ServerState::Full && !std::mem::replace(&mut self.told_full, true) {
            events.push(NoticeKind::MaximumLoad);
        } else if self.state == ServerState::Up && std::mem::replace(&mut self.told_full, false) {
            events.push(NoticeKind::AvailableAgain);
        }
        events
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::Load;

    fn report(load: f64) -> ServerReport {
        ServerReport::load_only(Load::try_from(load).unwrap())
    }

    /// The events of each step: a load, or `None` for a failure.
    fn events(steps: &[Option<f64>]) -> Vec<Vec<NoticeKind>> {
        let mut record = ServerRecord::new("host:2000".parse().unwrap(), false);
        let change = |step: &Option<f64>| match step {
            Some(load) => record.succeeded(Arc::new(report(*load)), Instant::now(), 95.0),
            None => record.failed(ProbeError::Connection(String::new())),
        };
        steps.iter().map(change).map(|change| change.map(|(_, events)| events).unwrap_or_default()).collect()
    }

    #[test]
    fn the_administrator_hears_of_four_events() {
        use NoticeKind::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};
        assert_eq!(events(&[Some(1.0), Some(2.0)]), [vec![], vec![]], "a server that is well is no news");
        assert_eq!(events(&[None, None, Some(1.0)]), [vec![NotResponding], vec![], vec![WorkingAgain]]);
        assert_eq!(events(&[Some(95.0), Some(99.0), Some(94.9)]), [vec![MaximumLoad], vec![], vec![AvailableAgain]]);
        assert_eq!(events(&[None, Some(96.0)]), [vec![NotResponding], vec![WorkingAgain, MaximumLoad]]);
        assert_eq!(
            events(&[Some(96.0), None, Some(96.0), None, Some(1.0)]),
            [
                vec![MaximumLoad],
                vec![NotResponding],
                vec![WorkingAgain],
                vec![NotResponding],
                vec![WorkingAgain, AvailableAgain]
            ]
        );
    }
}
