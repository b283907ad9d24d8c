//! What the registry knows of one simulation server, and what its changes mean. Part of the registry.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use serde::Serialize;

use super::probe_error::ProbeError;
use crate::session::mail::NoticeKind;
use crate::session::placement;
use crate::shared::domain::{ProjectUrl, ServerReport};

/// The state of a simulation server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ServerState {
    /// It was not probed yet.
    Unknown,
    /// It accepts clients.
    Up,
    /// Its load leaves no room for one more client, or it has no free slot.
    Full,
    /// It accepts no new clients: it drains itself, the configuration drains it, or no name resolves to it any more.
    Draining,
    /// Its last probe failed.
    Down,
}

/// One simulation server.
#[derive(Debug, Clone)]
pub struct ServerRecord {
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

/// A server has changed its state.
#[derive(Debug, PartialEq)]
pub struct ServerChange {
    /// Its new state.
    pub state: ServerState,
    /// Time of the change.
    pub at: SystemTime,
    /// The reason, as text.
    pub why: String,
    /// What is mailed to the administrator.
    pub events: Vec<NoticeKind>,
}

impl ServerState {
    /// The name of the state in pages and metrics.
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

impl ServerRecord {
    /// A server that was not probed yet.
    pub fn new(drained: bool) -> Self {
        Self {
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
    pub fn succeeded(&mut self, report: ServerReport, at: Instant, limit: f64) -> Option<ServerChange> {
        let (state, why) = self.judge(&report, limit);
        self.report = Some(Arc::new(report));
        self.answered = Some(at);
        self.enter(state, why)
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

    /// The last report in the terms of the placement policy. `None` takes the server out of placement: it is down, or
    /// it is drained and does not report counts, without which `accepting` can't be passed on.
    pub fn for_placement(&self) -> Option<placement::LoadReport> {
        let report = self.current()?;
        let accepting = self.state != ServerState::Draining;
        let instances = report.instances.map(|instances| placement::ClientCounts {
            present: instances.present(),
            places: instances.places,
            arrivals: instances.arrivals,
            accepting,
        });
        (accepting || instances.is_some()).then(|| placement::LoadReport { load: report.load.percent(), instances })
    }

    fn judge(&self, report: &ServerReport, limit: f64) -> (ServerState, impl FnOnce() -> String + use<>) {
        let load = report.load.percent();
        let no_place = report.instances.filter(|instances| instances.present() >= instances.places);
        let state = if self.drained || self.unlisted || report.draining {
            ServerState::Draining
        } else if load >= limit || no_place.is_some() {
            ServerState::Full
        } else {
            ServerState::Up
        };
        let reason = match (state, no_place) {
            (ServerState::Draining, _) if self.drained => " (drained by drainedServers)".to_owned(),
            (ServerState::Draining, _) if self.unlisted => " (no name leads to it any more)".to_owned(),
            (ServerState::Draining, _) => " (it drains itself)".to_owned(),
            (ServerState::Full, Some(full)) => format!(", {} clients in {} places", full.present(), full.places),
            (ServerState::Full, None) => format!(" of {limit:.1} %"),
            _ => String::new(),
        };
        (state, move || format!("load {load:.1} %{reason}"))
    }

    fn enter(&mut self, state: ServerState, why: impl FnOnce() -> String) -> Option<ServerChange> {
        let before = std::mem::replace(&mut self.state, state);
        if before == state {
            return None;
        }
        self.since = SystemTime::now();
        Some(ServerChange { state, at: self.since, why: why(), events: self.events(before) })
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
        let mut record = ServerRecord::new(false);
        let change = |step: &Option<f64>| match step {
            Some(load) => record.succeeded(report(*load), Instant::now(), 95.0),
            None => record.failed(ProbeError::Connection(String::new())),
        };
        steps.iter().map(change).map(|change| change.map(|change| change.events).unwrap_or_default()).collect()
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
