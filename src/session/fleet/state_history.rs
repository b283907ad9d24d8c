//! Changes of the state of simulation servers: each is one log line, one line of `/monitor`, and perhaps a notice to the
//! administrator. Part of the registry.

use std::collections::VecDeque;

use tokio::sync::mpsc::UnboundedSender;

use super::server_record::{ServerRecord, ServerState, StateChange};
use crate::session::config::SessionConfig;
use crate::session::mail::{self, Notice, NoticeKind};

/// The last changes, and the mailers that notify the administrator.
pub struct StateHistory {
    /// The last changes, the newest first.
    pub recent: VecDeque<StateChange>,
    /// One for each channel of notices.
    mailers: Vec<UnboundedSender<Notice>>,
}

/// Number of changes that are kept.
const KEPT: usize = 50;

impl StateHistory {
    /// No changes yet. Starts the mailers.
    pub fn new(config: &SessionConfig) -> Self {
        Self {
            recent: VecDeque::new(),
            mailers: mail::start(config),
        }
    }

    /// Adds and logs a change, and notifies the administrator of `event`. `record` is the server's record after it.
    pub fn add(&mut self, record: &ServerRecord, change: StateChange, event: Option<NoticeKind>) {
        let StateChange { at, server, state, why } = &change;
        let level = if *state == ServerState::Down {
            log::Level::Warn
        } else {
            log::Level::Info
        };
        log::log!(level, "{server}: {}: {why}", state.word());
        if let Some(event) = event {
            // The last known values: a server that does not answer reports no load, and one that works again no error.
            let load = record.report.as_ref().map(|report| report.load);
            let error = record.last_error.clone().filter(|_| !event.is_about_load());
            let notice = Notice {
                server: server.clone(),
                event,
                load,
                error,
                at: at.clone(),
            };
            for mailer in &self.mailers {
                // Without a receiver the server stops.
                mailer.send(notice.clone()).ok();
            }
        }
        self.recent.truncate(KEPT - 1);
        self.recent.push_front(change);
    }
}
