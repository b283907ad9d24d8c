//! Changes of the state of simulation servers, and of the names that resolve to them: each is one log line, one line of
//! `/monitor`, and the notices to the administrator. Part of the registry.

use std::collections::VecDeque;

use tokio::sync::mpsc::UnboundedSender;

use super::fleet_status::NameStatus;
use super::server_record::{ServerChange, ServerRecord, ServerState, StateChange};
use crate::session::config::SessionConfig;
use crate::session::mail::{self, Notice, NoticeKind};

/// The last changes, and the mailer that notifies the administrator.
pub struct StateHistory {
    /// The last changes, the newest first.
    pub recent: VecDeque<StateChange>,
    /// One for each channel of notices.
    mailers: Vec<UnboundedSender<Notice>>,
}

/// How many changes are kept.
const KEPT: usize = 50;

impl StateHistory {
    /// No changes yet. Starts the mailers.
    pub fn new(config: &SessionConfig) -> Self {
        Self { recent: VecDeque::new(), mailers: mail::start(config) }
    }

    /// Adds a change of a server whose record is now `record`.
    pub fn add(&mut self, record: &ServerRecord, (change, events): ServerChange) {
        // The last known values: a server that does not answer reports no load, and one that works again no error.
        let load = record.report.as_ref().map(|report| report.load);
        for event in events {
            let error = record.last_error.as_ref().filter(|_| !event.is_about_load()).map(ToString::to_string);
            self.notify(&Notice { server: change.server.clone(), event, load, error, at: change.at });
        }
        self.list(change);
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
        for mailer in &self.mailers {
            // Without a receiver the server stops.
            mailer.send(notice.clone()).ok();
        }
    }
}
