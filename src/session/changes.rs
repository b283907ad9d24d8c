//! Changes of simulation servers' states: each is one log line, one line of `/monitor`, and the notices to the
//! administrator. Part of the registry.

use std::collections::VecDeque;

use actix::prelude::*;

use super::fleet_status::{State, StateChange};
use super::notices::Notice;
use super::watched::{Change, Watched};
use crate::shared::address::PublicAddress;

/// The last changes, and who else is told of them.
pub struct Changes {
    recent: VecDeque<StateChange>,
    notices: Option<Recipient<Notice>>,
}

/// How many changes are kept.
const KEPT: usize = 50;

impl Changes {
    /// No changes yet; notices go to this actor.
    #[must_use]
    pub fn new(notices: Option<Recipient<Notice>>) -> Self {
        Self { recent: VecDeque::new(), notices }
    }

    /// The last changes, the newest first.
    #[must_use]
    pub fn recent(&self) -> &VecDeque<StateChange> {
        &self.recent
    }

    /// Tells a change of a server, which is now as it is `watched`.
    pub fn tell(&mut self, server: &PublicAddress, watched: &Watched, change: Change) {
        let Change { state, at, why, events } = change;
        let level = if state == State::Down { log::Level::Warn } else { log::Level::Info };
        log::log!(level, "{server}: {}: {why}", state.word());
        self.recent.truncate(KEPT - 1);
        self.recent.push_front(StateChange { at, server: server.clone(), state, why });
        let Some(notices) = &self.notices else {
            return;
        };
        let error = watched.error.as_ref().map(ToString::to_string);
        for event in events {
            let notice = Notice { server: server.clone(), event, load: watched.load(), error: error.clone(), at };
            if let Err(lost) = notices.try_send(notice) {
                log::error!("{server}: no notice is sent: {lost}");
            }
        }
    }
}
