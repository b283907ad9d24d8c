//! Changes of the state of simulation servers: each is one log line, one line of `/monitor`, and perhaps a notice to the
//! administrator. Part of the registry.

use std::collections::VecDeque;

use tokio::sync::mpsc::UnboundedSender;

use super::server_record::{ServerChange, StateChange, StateName};
use crate::session::config::SessionConfig;
use crate::session::mail::{self, Notice};

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

    /// Adds and logs a change, and notifies the administrator.
    pub fn add(&mut self, ServerChange { change, notice }: ServerChange) {
        let level = if change.state == StateName::Down {
            log::Level::Warn
        } else {
            log::Level::Info
        };
        log::log!(level, "{}: {}: {}", change.server, change.state, change.why);
        if let Some(notice) = notice {
            for mailer in &self.mailers {
                // Without a receiver the server stops.
                mailer.send(notice.clone()).ok();
            }
        }
        self.recent.truncate(KEPT - 1);
        self.recent.push_front(change);
    }
}
