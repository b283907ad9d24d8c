//! Changes of the state of simulation servers, and of the names that resolve to them: each is one log line, one line of
//! `/monitor`, and the notices to the administrator. Part of the registry.

use std::collections::VecDeque;

use super::fleet_status::{NameStatus, StateChange};
use super::server_record::{ServerChange, ServerRecord, ServerState};
use crate::session::config::SessionConfig;
use crate::session::mail::{self, Mailer, Notice, NoticeKind, Topic};
use crate::shared::domain::PublicAddress;
use crate::shared::run::Supervisor;

/// The last changes, and the mailer that notifies the administrator.
pub struct StateHistory {
    recent: VecDeque<StateChange>,
    /// One for each channel of notices.
    mailers: Supervisor<&'static str, Mailer>,
}

/// How many changes are kept.
const KEPT: usize = 50;

impl StateHistory {
    /// No changes yet. Starts the mailers.
    pub fn new(config: &SessionConfig) -> Self {
        Self { recent: VecDeque::new(), mailers: mail::start(config) }
    }

    /// Starts a new mailer if the last one has panicked. Its unsent notices are lost.
    ///
    /// # Errors
    /// When there were too many panics.
    pub fn restart_gone(&mut self) -> Result<(), String> {
        self.mailers.restart_gone()
    }

    /// Returns the last changes, the newest first.
    pub fn recent(&self) -> &VecDeque<StateChange> {
        &self.recent
    }

    /// Adds a change of a server whose record is now `record`.
    pub fn add(&mut self, server: &PublicAddress, record: &ServerRecord, change: ServerChange) {
        let ServerChange { state, at, why, events } = change;
        self.list(StateChange { at, server: server.to_string(), state, why });
        // The last known values: a server that does not answer reports no load, and one that works again no error.
        let load = record.report.as_ref().map(|report| report.load);
        for event in events {
            let error = record.last_error.as_ref().filter(|_| event.topic() == Topic::Health).map(ToString::to_string);
            self.notify(&Notice { server: server.to_string(), event, load, error, at });
        }
    }

    /// Adds that lookups of a name have begun to fail, or succeed again.
    pub fn add_name(&mut self, NameStatus { name, servers, error, since }: NameStatus) {
        let (state, event, why) = match &error {
            Some(error) => {
                let why = format!("{error}; the servers that it led to before stay");
                (ServerState::Down, NoticeKind::NotResponding, why)
            }
            None => (ServerState::Up, NoticeKind::WorkingAgain, format!("it leads to {servers} simulation servers")),
        };
        self.list(StateChange { at: since, server: name.clone(), state, why });
        self.notify(&Notice { server: name, event, load: None, error, at: since });
    }

    fn list(&mut self, change: StateChange) {
        let StateChange { server, state, why, .. } = &change;
        let level = if *state == ServerState::Down { log::Level::Warn } else { log::Level::Info };
        log::log!(level, "{server}: {}: {why}", state.word());
        self.recent.truncate(KEPT - 1);
        self.recent.push_front(change);
    }

    fn notify(&self, notice: &Notice) {
        for mailer in self.mailers.all() {
            if let Err(lost) = mailer.try_send(notice.clone()) {
                log::error!("{}: no notice is sent: {lost}", notice.server);
            }
        }
    }
}
