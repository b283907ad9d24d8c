//! A simulation that has a place or waits for one, and what becomes of it.

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
use crate::simulation::ends::{End, EndReason, Ended, Taken};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Simulation, SimulationChange, Stage};
use crate::simulation::who::Who;

/// What its owner reports of a simulation.
#[derive(Debug)]
pub enum Report {
    /// Something that is shown.
    Change(SimulationChange),
    /// An event, in words.
    Event(String),
    /// How it ends. The first one counts.
    End(End),
}

/// A simulation of this server.
pub(super) struct Present {
    /// The port that is lent, which is not always the one that Webots took.
    pub lent: Option<u16>,
    /// The address by which its client counts.
    pub address: Option<IpAddr>,
    /// Hears what becomes of it.
    pub listener: Recipient<SlotEvent>,
    /// As pages show it.
    pub shown: Simulation,
    client: Peer,
    repository: String,
    events: Vec<String>,
    how: Option<End>,
}

/// How many events are kept of a simulation.
const MAX_EVENTS: usize = 60;
/// How many letters are kept of an event.
const EVENT_LENGTH: usize = 500;

/// Where more simulations than this wait for clients that are away: the one that has to end. It has been away longest, of
/// the address that has most of them, so that who comes and goes harms himself only.
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
        (client, who): (Peer, Who),
        listener: Recipient<SlotEvent>,
    ) -> Self {
        let shown = Simulation {
            id,
            world: world.to_string(),
            who,
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

    /// By what its client shares the places.
    pub(super) fn parties(&self) -> Vec<Party> {
        let user = self.shown.who.user.clone().map(Party::User);
        self.address.map(Party::Address).into_iter().chain(user).collect()
    }

    /// Lends it a port.
    pub(super) fn lend(&mut self, port: u16) {
        self.lent = Some(port);
        self.shown.port = Some(port);
        self.shown.stage = Stage::CheckingOut;
        self.note(&format!("it is given port {port}, its world is checked out"));
    }

    /// Takes in what its owner reports.
    pub(super) fn take(&mut self, report: Report) {
        match report {
            Report::Change(change) => self.shown.apply(change),
            Report::Event(event) => self.note(&event),
            Report::End(end) => drop(self.how.get_or_insert(end)),
        }
    }

    /// Who may read the output may read this, so it holds no address and no path of the machine.
    fn note(&mut self, event: &str) {
        if self.events.len() < MAX_EVENTS {
            self.events.push(format!(
                "{} {}",
                timestamp(SystemTime::now()),
                excerpt(&without_paths(event), EVENT_LENGTH)
            ));
        }
    }

    /// What it leaves when its owner is gone. One that says nothing has lost its client, or panicked while Webots ran.
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
            who: self.shown.who,
            repository: self.repository,
            world: self.shown.world,
            port: self.shown.port,
            log: self.shown.log,
            events: self.events,
            how,
        }
    }
}
