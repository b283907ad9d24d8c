//! What a session keeps for a client that returns: its token, the texts to send again, and the deadline.

use std::net::IpAddr;
use std::time::{Duration, Instant};

use actix::prelude::*;

use crate::shared::run::seconds_since_1970;
use crate::simulation::protocol;
use crate::simulation::sessions::{Registration, Token};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{Move, Report, SlotError, SlotLease, SlotPool, UpdateSimulation};
use crate::simulation::snapshot::SimulationChange;

/// The state for a client that returns.
pub struct Resumption {
    registration: Registration,
    /// The last token that the client got; `None` before it can return.
    token: Option<Token>,
    simulation: SimulationId,
    slots: Addr<SlotPool>,
    /// When Webots was started: the time limit starts then.
    pub(super) launched: Instant,
    /// The texts that its project requests.
    pub(super) texts: Vec<String>,
    url: String,
    /// When the simulation ends because it is paused, if it does.
    pub(super) idle_end: Option<Instant>,
    /// The timer that ends the wait for the client, if there is one.
    pub(super) deadline: Option<SpawnHandle>,
    /// Why the simulation has ended, if it has.
    ended: Option<String>,
}

/// How many seconds are left until then, rounded up.
pub fn seconds_until(then: Instant) -> u64 {
    (then.saturating_duration_since(Instant::now()) + Duration::from_millis(999)).as_secs()
}

impl Resumption {
    /// Creates it for a registered session with this lease.
    pub fn new(registration: Registration, lease: &SlotLease, slots: Addr<SlotPool>) -> Self {
        Self {
            registration,
            token: None,
            simulation: lease.id(),
            slots,
            launched: Instant::now(),
            texts: Vec::new(),
            url: String::new(),
            idle_end: None,
            deadline: None,
            ended: None,
        }
    }

    /// Webots is ready at this URL: from now on the client may come back. Returns the texts that offer it.
    pub fn ready(&mut self, url: String, absence: Duration) -> [String; 2] {
        self.url = url;
        self.offer(absence)
    }

    fn offer(&mut self, absence: Duration) -> [String; 2] {
        let token = self.token.insert(self.registration.token());
        [protocol::absence(absence.as_secs()), protocol::resume(token)]
    }

    /// Whether the client may return.
    pub fn is_ready(&self) -> bool {
        self.token.is_some()
    }

    /// Why a client with this token may not return, as text for it; `None` if it may.
    pub fn refusal(&self, token: &Token) -> Option<String> {
        if self.token.as_ref() != Some(token) {
            return Some(protocol::taken_over());
        }
        self.ended.as_ref().map(|why| protocol::ended(Some(why)))
    }

    /// Requests that the slot counts for this address.
    pub fn move_to(
        &self,
        address: Option<IpAddr>,
    ) -> impl Future<Output = Result<Result<(), SlotError>, MailboxError>> + use<> {
        self.slots.send(Move { id: self.simulation, address })
    }

    /// Makes the slot count for this address again.
    pub fn stay_at(&self, address: Option<IpAddr>) {
        self.slots.do_send(Move { id: self.simulation, address });
    }

    /// Records that the simulation has ended, for a client that returns. Only the first reason counts.
    pub fn end(&mut self, why: &str) {
        self.ended.get_or_insert_with(|| why.to_owned());
    }

    /// Records that the client has disconnected; the simulation waits for this long, unless it has ended. Returns
    /// whether it waits.
    pub fn away(&self, absence: Duration) -> bool {
        if self.ended.is_none() {
            self.show(Some(seconds_since_1970() + absence.as_secs()));
        }
        self.ended.is_none()
    }

    /// Records that the client is back. Returns the texts for it: those that it got before, and a new token.
    pub fn back(&mut self, timeout: u64, absence: Duration) -> Vec<String> {
        self.show(None);
        let left = timeout.saturating_sub(self.launched.elapsed().as_secs());
        let mut texts = vec![protocol::session(self.simulation), protocol::shutdown_timeout(left)];
        texts.extend(self.texts.iter().cloned());
        texts.push(protocol::webots(&self.url));
        texts.extend(self.offer(absence));
        texts.extend(self.idle_end.map(|end| protocol::idle(Some(seconds_until(end)))));
        texts
    }

    fn show(&self, until: Option<u64>) {
        self.slots.do_send(UpdateSimulation(self.simulation, Report::Change(SimulationChange::Away(until))));
    }
}
