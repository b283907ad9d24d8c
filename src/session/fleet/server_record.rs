//! What the registry knows of one simulation server, and which of its changes are mailed. Part of the registry.

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use serde::{Serialize, Serializer};

use crate::session::line::LineStatus;
use crate::session::mail::{Notice, NoticeKind};
use crate::shared::domain::{Failure, PublicAddress, ReadyCount, ReadyEntry, ServerReport};
use crate::shared::run::timestamp;

/// What is known of a simulation server.
#[derive(Debug, Clone)]
pub enum ServerState {
    /// It was not probed yet.
    Unknown,
    /// Its last probe failed.
    Down {
        /// Why.
        failure: Failure,
        /// Duration of the failed probe.
        latency: Duration,
        /// Its last answer before, if it ever gave one.
        last_answer: Option<Answer>,
    },
    /// Its last probe was answered.
    Answering {
        /// The answer.
        answer: Answer,
        /// Whether it takes clients, by this answer.
        intake: Intake,
    },
}

/// A simulation server's answer to a probe.
#[derive(Debug, Clone)]
pub struct Answer {
    /// What it reports.
    pub report: Arc<ServerReport>,
    /// When the answer arrived.
    pub at: Instant,
    /// Duration of the probe.
    pub latency: Duration,
}

/// Whether a simulation server that answers takes clients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Intake {
    /// It accepts clients.
    Up,
    /// Its load leaves no room for one more client, or it has no free slot.
    Full,
    /// It accepts no new clients: it drains itself, or the configuration drains it.
    Draining,
}

/// The name of a state in pages, `/status`, metrics and the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StateName {
    /// See [`ServerState::Unknown`].
    Unknown,
    /// See [`Intake::Up`].
    Up,
    /// See [`Intake::Full`].
    Full,
    /// See [`Intake::Draining`].
    Draining,
    /// See [`ServerState::Down`].
    Down,
}

/// One simulation server.
#[derive(Debug, Clone)]
pub struct ServerRecord {
    /// Its address; unique in the fleet.
    pub address: PublicAddress,
    /// Whether it is listed in `drainedServers`.
    pub drained: bool,
    /// What is known of it, as of its last probe.
    pub state: ServerState,
    /// When its state got its present name, as text.
    pub since: String,
}

/// A simulation server has changed its state.
#[derive(Debug, Clone, Serialize)]
pub struct StateChange {
    /// When it changed, as text.
    pub at: String,
    /// The simulation server's address.
    pub server: String,
    /// Its new state.
    pub state: StateName,
    /// The reason, as text.
    pub why: String,
}

/// A change of a server's state, and the notice of it to the administrator, if any.
#[derive(Debug)]
pub struct ServerChange {
    /// The change.
    pub change: StateChange,
    /// The notice.
    pub notice: Option<Notice>,
}

impl StateName {
    /// All names.
    pub const ALL: [Self; 5] = [Self::Unknown, Self::Up, Self::Full, Self::Draining, Self::Down];

    /// The name as text.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Up => "up",
            Self::Full => "full",
            Self::Draining => "draining",
            Self::Down => "down",
        }
    }
}

impl fmt::Display for StateName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl Serialize for StateName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

impl ServerState {
    /// Its name.
    pub fn name(&self) -> StateName {
        match self {
            Self::Unknown => StateName::Unknown,
            Self::Down { .. } => StateName::Down,
            Self::Answering { intake, .. } => match intake {
                Intake::Up => StateName::Up,
                Intake::Full => StateName::Full,
                Intake::Draining => StateName::Draining,
            },
        }
    }

    /// The report of a server that answers.
    pub fn report(&self) -> Option<&ServerReport> {
        match self {
            Self::Answering { answer, .. } => Some(&answer.report),
            Self::Unknown | Self::Down { .. } => None,
        }
    }

    /// The last answer; of a server that is down, the one before.
    pub fn last_answer(&self) -> Option<&Answer> {
        match self {
            Self::Unknown => None,
            Self::Down { last_answer, .. } => last_answer.as_ref(),
            Self::Answering { answer, .. } => Some(answer),
        }
    }

    /// Why the last probe failed, if it did.
    pub fn failure(&self) -> Option<&Failure> {
        match self {
            Self::Down { failure, .. } => Some(failure),
            Self::Unknown | Self::Answering { .. } => None,
        }
    }

    /// Duration of the last probe.
    pub fn latency(&self) -> Option<Duration> {
        match self {
            Self::Unknown => None,
            Self::Down { latency, .. } => Some(*latency),
            Self::Answering { answer, .. } => Some(answer.latency),
        }
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
        }
    }

    /// Records an answer. From a load of `limit` percent the server counts as full. Returns what has changed.
    pub fn answered(&mut self, answer: Answer, limit: f64) -> Option<ServerChange> {
        let load = answer.report.load.percent();
        let (intake, why) = self.intake(&answer.report, limit);
        self.enter(ServerState::Answering { answer, intake }, || {
            format!("load {load:.1} %{why}")
        })
    }

    /// Records that a probe has failed. Returns what has changed.
    pub fn failed(&mut self, failure: Failure, latency: Duration) -> Option<ServerChange> {
        let why = failure.in_full();
        let last_answer = self.state.last_answer().cloned();
        let state = ServerState::Down {
            failure,
            latency,
            last_answer,
        };
        self.enter(state, || why)
    }

    /// Whether the server takes clients by this report, and the reason if it does not, as the end of a text.
    fn intake(&self, report: &ServerReport, limit: f64) -> (Intake, String) {
        let full = report
            .instances
            .filter(|instances| instances.present() >= instances.slots);
        if self.drained {
            (Intake::Draining, " (drained by drainedServers)".to_owned())
        } else if report.draining {
            (Intake::Draining, " (it drains itself)".to_owned())
        } else if let Some(full) = full {
            let why = format!(", {} clients in {} places", full.present(), full.slots);
            (Intake::Full, why)
        } else if report.load.percent() >= limit {
            (Intake::Full, format!(" of {limit:.1} %"))
        } else {
            (Intake::Up, String::new())
        }
    }

    fn enter(&mut self, state: ServerState, why: impl FnOnce() -> String) -> Option<ServerChange> {
        let before = std::mem::replace(&mut self.state, state);
        let name = self.state.name();
        if before.name() == name {
            return None;
        }
        self.since = timestamp(SystemTime::now());
        let server = self.address.to_string();
        let last = self.state.last_answer().map(|answer| &answer.report);
        let notice = event(&before, &self.state).map(|(event, failure)| Notice {
            server: server.clone(),
            event,
            // The last known one: a server that does not answer reports none.
            load: last.map(|report| report.load),
            places: last
                .and_then(|report| report.instances)
                .map(|instances| (instances.present(), instances.slots)),
            failure: failure.cloned(),
            at: self.since.clone(),
        });
        let change = StateChange {
            at: self.since.clone(),
            server,
            state: name,
            why: why(),
        };
        Some(ServerChange { change, notice })
    }
}

/// The event that a change of state is to the administrator, if any, with the failure that begins or ends with it. These
/// are the four events of the original.
fn event<'a>(before: &'a ServerState, after: &'a ServerState) -> Option<(NoticeKind, Option<&'a Failure>)> {
    if let Some(failure) = after.failure() {
        return Some((NoticeKind::NotResponding, Some(failure)));
    }
    if let Some(failure) = before.failure() {
        return Some((NoticeKind::WorkingAgain, Some(failure)));
    }
    match (before.name(), after.name()) {
        (_, StateName::Full) => Some((NoticeKind::MaximumLoad, None)),
        (StateName::Full, StateName::Up) => Some((NoticeKind::AvailableAgain, None)),
        _ => None,
    }
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
    /// The clients that wait.
    pub line: LineStatus,
    /// How many of each listed world are to be kept ready now.
    pub ready: Vec<ReadyCount>,
    /// The entries of `POST /ready`.
    pub requested: Vec<ReadyEntry>,
}

impl FleetStatus {
    /// Number of simulation servers in a state of this name.
    pub fn count(&self, state: StateName) -> usize {
        let names = self.servers.iter().map(|server| server.record.state.name());
        names.filter(|name| *name == state).count()
    }

    /// Number of simulations of this kind that clients can take at once.
    pub fn ready(&self, one: &ReadyCount) -> u32 {
        let reports = self.servers.iter().filter_map(|server| server.record.state.report());
        reports
            .map(|report| report.ready(&one.world, one.mode))
            .fold(0, u32::saturating_add)
    }

    /// Number of simulation servers that answer.
    pub fn answering(&self) -> usize {
        let reports = self.servers.iter().map(|server| server.record.state.report());
        reports.flatten().count()
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
    pub failure: Option<Failure>,
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
    use crate::shared::domain::{Load, Reason};

    fn answer(load: f64) -> Answer {
        Answer {
            report: Arc::new(ServerReport::load_only(Load::try_from(load).unwrap())),
            at: Instant::now(),
            latency: Duration::ZERO,
        }
    }

    /// The notice after each step, if any. A step is a load, or `None` for a failure.
    fn notices(steps: &[Option<f64>]) -> Vec<Option<Notice>> {
        let mut record = ServerRecord::new("host:2000".parse().unwrap());
        let change = |step: &Option<f64>| match step {
            Some(load) => record.answered(answer(*load), 95.0),
            None => record.failed(Failure::new(Reason::NoAnswer, "broken"), Duration::ZERO),
        };
        steps
            .iter()
            .map(change)
            .map(|change| change.and_then(|change| change.notice))
            .collect()
    }

    fn events(steps: &[Option<f64>]) -> Vec<Option<NoticeKind>> {
        let notices = notices(steps).into_iter();
        notices.map(|notice| notice.map(|notice| notice.event)).collect()
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

    #[test]
    fn a_notice_has_the_last_load_and_the_failure_that_begins_or_ends() {
        let notices = notices(&[Some(3.0), None, Some(4.0)]);
        let [None, Some(down), Some(up)] = notices.as_slice() else {
            panic!("{notices:?}");
        };
        for (notice, load) in [(down, 3.0), (up, 4.0)] {
            assert_eq!(notice.load.map(Load::percent), Some(load));
            assert_eq!(
                notice.failure.as_ref().map(|failure| failure.reason),
                Some(Reason::NoAnswer)
            );
        }
    }
}
