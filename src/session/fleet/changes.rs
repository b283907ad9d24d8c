//! Changes of the state of simulation servers, and of the names that lead to some: each is one log line, one line of `/monitor`, and the notices to the
//! administrator. Part of the registry.

use std::collections::VecDeque;
use std::time::SystemTime;

use actix::prelude::*;

use super::fleet_status::{State, StateChange};
use super::names::Turn;
use super::server_record::{Change, ServerRecord};
use crate::session::config::{DnsName, SessionConfig};
use crate::session::mail::{self, Event, Mailer, Notice, Topic};
use crate::shared::domain::PublicAddress;

/// The last changes, and the mailer that tells the administrator.
pub struct Changes {
    recent: VecDeque<StateChange>,
    mailer: Option<Addr<Mailer>>,
}

/// How many changes are kept.
const KEPT: usize = 50;

impl Changes {
    /// No changes yet; notices go to this actor.
    #[must_use]
    pub fn new(mailer: Option<Addr<Mailer>>) -> Self {
        Self { recent: VecDeque::new(), mailer }
    }

    /// Starts another mailer if the last one has panicked: actix does not restart an actor that has.
    pub fn restart_mailer_if_gone(&mut self, config: &SessionConfig) {
        if self.mailer.as_ref().is_some_and(|mailer| !mailer.connected()) {
            log::error!("the mailer is gone, a new one is started; what it had not sent is lost");
            self.mailer = mail::start(config);
        }
    }

    /// Returns the last changes, the newest first.
    #[must_use]
    pub fn recent(&self) -> &VecDeque<StateChange> {
        &self.recent
    }

    /// Adds a change of a server whose record is now `record`.
    pub fn add(&mut self, server: &PublicAddress, record: &ServerRecord, change: Change) {
        let Change { state, still, at, why, events } = change;
        let words = if still { "still " } else { "" };
        self.list(words, StateChange { at, server: server.to_string(), state, why });
        // The last that is known: a server that does not answer tells no load, and one that works again no error.
        let load = record.report.as_ref().map(|report| report.load);
        for event in events {
            let error = record.last_error.as_ref().filter(|_| event.topic() == Topic::Health).map(ToString::to_string);
            self.notify(Notice { server: server.to_string(), event, load, error, at });
        }
    }

    /// Adds that a name has begun to fail, or works again.
    pub fn add_name(&mut self, name: &DnsName, turn: Turn) {
        let (at, server) = (SystemTime::now(), name.to_string());
        let (state, event, why, error) = match turn {
            Turn::Fails(error) => {
                let why = format!("{error}; the servers that it led to before stay");
                (State::Down, Event::LookupFails, why, Some(error))
            }
            Turn::WorksAgain(servers) => {
                (State::Up, Event::LookupWorks, format!("it leads to {servers} simulation servers"), None)
            }
        };
        self.list("", StateChange { at, server: server.clone(), state, why });
        self.notify(Notice { server, event, load: None, error, at });
    }

    fn list(&mut self, words: &str, change: StateChange) {
        let StateChange { server, state, why, .. } = &change;
        let level = if *state == State::Down { log::Level::Warn } else { log::Level::Info };
        log::log!(level, "{server}: {words}{}: {why}", state.word());
        self.recent.truncate(KEPT - 1);
        self.recent.push_front(change);
    }

    fn notify(&self, notice: Notice) {
        let Some(mailer) = &self.mailer else {
            return;
        };
        let server = notice.server.clone();
        if let Err(lost) = mailer.try_send(notice) {
            log::error!("{server}: no notice is sent: {lost}");
        }
    }
}
