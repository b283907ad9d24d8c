//! A simulation that has a slot or waits for one, and its record.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::SystemTime;

use actix::Recipient;

use super::party::Party;
use super::slot_event::SlotEvent;
use crate::shared::domain::ProjectUrl;
use crate::shared::http::Peer;
use crate::shared::run::{seconds_since_1970, timestamp};
use crate::shared::text::{excerpt, without_paths};
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{End, EndReason, Ended, Taken};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Simulation, SimulationChange, Stage};

/// A report of its owner about a simulation.
#[derive(Debug)]
pub enum Report {
    /// A change of what pages show.
    Change(SimulationChange),
    /// An event, as text.
    Event(String),
    /// How it ends. Only the first report counts.
    End(End),
}

/// A simulation of this server.
pub(super) struct Present {
    /// The leased port, which Webots may not have used.
    pub lent: Option<u16>,
    /// The address that counts for the limit per address.
    pub address: Option<IpAddr>,
    /// Receives its events.
    pub listener: Recipient<SlotEvent>,
    /// The part that pages show.
    pub shown: Simulation,
    client: Peer,
    repository: String,
    events: Vec<String>,
    how: Option<End>,
}

/// Number of events that are kept of a simulation.
const MAX_EVENTS: usize = 60;
/// Longest text of an event, in characters.
const MAX_EVENT_LENGTH: usize = 500;

/// The simulation to end if more than `most` wait for disconnected clients. It has waited longest, among those of the
/// address that has most of them, so that a client that reconnects often harms only itself.
pub(super) fn longest_away(all: &BTreeMap<SimulationId, Present>, most: usize) -> Option<SimulationId> {
    let away = || all.values().filter(|one| one.shown.away_until.is_some());
    let of_address = |address| away().filter(|one| one.address == address).count();
    let longest = |one: &&Present| (Reverse(of_address(one.address)), one.shown.away_until);
    let too_many = away().count() > most;
    away().min_by_key(longest).filter(|_| too_many).map(|one| one.shown.id)
}

impl Present {
    /// A simulation that a client has just asked for.
    pub(super) fn new(
        id: SimulationId,
        world: &ProjectUrl,
        (client, identity): (Peer, ClientIdentity),
        listener: Recipient<SlotEvent>,
    ) -> Self {
        let shown = Simulation {
            id,
            world: world.to_string(),
            identity,
            stage: Stage::Queued,
            since: seconds_since_1970(),
            launched: None,
            pid: None,
            cgroup: None,
            port: None,
            gpu: None,
            away_until: None,
            version: None,
            log: None,
        };
        let (address, repository) = (client.rate_limit_key(), world.repository());
        let mut present =
            Self { lent: None, address, listener, shown, client, repository, events: Vec::new(), how: None };
        present.note(&format!("its client asks for {world}"));
        present
    }

    /// The parties that its client belongs to.
    pub(super) fn parties(&self) -> Vec<Party> {
        let user = self.shown.identity.user.clone().map(Party::User);
        self.address.map(Party::Address).into_iter().chain(user).collect()
    }

    /// Lends it a port.
    pub(super) fn lend(&mut self, port: u16) {
        self.lent = Some(port);
        self.shown.port = Some(port);
        self.shown.stage = Stage::CheckingOut;
        self.note(&format!("it is given port {port}, its world is checked out"));
    }

    /// Records a report of its owner.
    pub(super) fn take(&mut self, report: Report) {
        match report {
            Report::Change(change) => self.shown.apply(change),
            Report::Event(event) => self.note(&event),
            Report::End(end) => drop(self.how.get_or_insert(end)),
        }
    }

    /// Adds an event. Clients that may read the output may read it, so it contains no address and no path of the
    /// machine.
    fn note(&mut self, event: &str) {
        if self.events.len() < MAX_EVENTS {
            self.events.push(format!(
                "{} {}",
                timestamp(SystemTime::now()),
                excerpt(&without_paths(event), MAX_EVENT_LENGTH)
            ));
        }
    }

    /// The record of its end, once its owner has stopped. An owner that has reported no end has lost its client, or
    /// panicked while Webots ran.
    pub(super) fn ended(mut self) -> Ended {
        let how = self.how.take().unwrap_or_else(|| {
            let (reason, why) = match self.shown.launched {
                None => (EndReason::Left, "Its client has gone"),
                Some(_) => (EndReason::Fault, "The simulation was lost by a fault of this server"),
            };
            End { reason, why: why.to_owned(), taken: Taken::default() }
        });
        self.events.truncate(MAX_EVENTS - 1);
        self.note(&format!("ended ({}): {}", how.reason.label(), how.why));
        Ended {
            id: self.shown.id,
            begin: self.shown.since,
            end: seconds_since_1970(),
            client: self.client.to_string(),
            identity: self.shown.identity,
            repository: self.repository,
            world: self.shown.world,
            port: self.shown.port,
            log: self.shown.log,
            events: self.events,
            how,
        }
    }
}
