//! Actor: leases slots to simulations, keeps the queue, and knows all simulations of this server.
//!
//! One for the whole server, created at start; it never ends. A slot is a streaming port. A session creates a
//! [`SlotLease`], and receives its position in the queue until a port is granted. Dropping the lease leaves the queue
//! or frees the port, so that neither leaks in any state or after any panic.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::RangeInclusive;
use std::time::Duration;

use actix::prelude::*;

use super::messages::{Acquire, GetSnapshot, Move, Release, StopOne, UpdateSimulation};
use super::party::{Party, Share, Shares};
use super::present::{Present, Report, longest_away};
use super::slot_error::SlotError;
use super::slot_event::SlotEvent;
use crate::shared::domain::{Instances, ProjectUrl};
use crate::shared::http::Peer;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{End, EndReason, Ends, Taken};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{SimulationChange, Snapshot, Stage};

/// A slot, or a position in the queue for one. Dropping it releases it.
#[derive(Debug)]
pub struct SlotLease {
    id: SimulationId,
    slots: Addr<SlotPool>,
}

/// A port for one simulation, with its lease.
#[derive(Debug)]
pub struct Slot {
    /// Frees the slot when it is dropped.
    pub lease: SlotLease,
    /// The port on which Webots listens.
    pub port: u16,
}

/// The actor.
pub struct SlotPool {
    ports: RangeInclusive<u16>,
    queue_capacity: usize,
    shares: Shares,
    /// Number of leases that were requested, including those of clients that were refused.
    arrivals: u64,
    present: BTreeMap<SimulationId, Present>,
    queue: VecDeque<Waiting>,
    /// Records each end.
    ends: Option<Ends>,
}

struct Waiting {
    id: SimulationId,
    parties: Vec<Party>,
    client: Recipient<SlotEvent>,
    sent_position: Option<usize>,
}

/// Interval between two checks of the ports that other programs have used.
const RECHECK: Duration = Duration::from_secs(1);

impl SlotPool {
    /// Leases these ports; `queue_capacity` clients may wait. One address may have `per_address` slots, and the same
    /// share of the queue; without it, all of both.
    pub fn new(ports: RangeInclusive<u16>, queue_capacity: usize, per_address: Option<usize>) -> Self {
        let share = |slots| Share::new(slots, ports.len(), queue_capacity);
        let shares = Shares { address: share(per_address), user: share(None) };
        let (present, queue) = (BTreeMap::new(), VecDeque::new());
        Self { ports, queue_capacity, shares, arrivals: 0, present, queue, ends: None }
    }

    /// One user may have this many slots, and the same share of the queue; without a number, all of both.
    pub fn with_share_of_users(mut self, per_user: Option<usize>) -> Self {
        self.shares.user = Share::new(per_user, self.ports.len(), self.queue_capacity);
        self
    }

    /// Records each end with `ends`.
    pub fn with_ends(self, ends: Ends) -> Self {
        Self { ends: Some(ends), ..self }
    }

    /// The position of the first client in the queue whose address and user may have another slot.
    fn next_in_queue(&self) -> Option<usize> {
        let mut lent: HashMap<Party, usize> = HashMap::new();
        for party in self.present.values().filter(|one| one.lent.is_some()).flat_map(Present::parties) {
            *lent.entry(party).or_default() += 1;
        }
        let may_have_one = |party: &Party| lent.get(party).is_none_or(|slots| *slots < self.shares.of(party).slots);
        self.queue.iter().position(|waiting| waiting.parties.iter().all(may_have_one))
    }

    /// What the clients of a party have.
    fn share_of(&self, party: &Party) -> Share {
        let present = self.present.values().filter(|one| one.parties().contains(party));
        let (lent, waiting): (Vec<_>, Vec<_>) = present.partition(|one| one.lent.is_some());
        Share { slots: lent.len(), waiting: waiting.len() }
    }

    /// Why another client of these parties may not wait, if so.
    fn refusal(&self, parties: &[Party]) -> Option<SlotError> {
        let mut shares = parties.iter().map(|party| (party, self.shares.of(party), self.share_of(party)));
        if let Some((party, _, has)) = shares.find(|(_, may, has)| may.is_used_up(*has)) {
            return Some(party.refusal(has));
        }
        let (places, waiting) = (self.ports.len(), self.queue.len());
        (waiting >= self.queue_capacity).then_some(SlotError::QueueFull { places, waiting })
    }

    /// Grants free slots to the clients in the queue, and sends the others their position.
    fn serve(&mut self) {
        self.grant();
        for (ahead, waiting) in self.queue.iter_mut().enumerate() {
            if waiting.sent_position != Some(ahead) && waiting.client.try_send(SlotEvent::Queued(ahead)).is_ok() {
                waiting.sent_position = Some(ahead);
            }
        }
    }

    fn grant(&mut self) {
        while let Some(next) = self.next_in_queue()
            && let Some(port) = self.free_port()
            && let Some(first) = self.queue.remove(next)
        {
            match first.client.try_send(SlotEvent::Granted(port)) {
                Ok(()) => {
                    if let Some(present) = self.present.get_mut(&first.id) {
                        present.lend(port);
                    }
                }
                // It keeps its position in the queue until the next check.
                Err(SendError::Full(_)) => {
                    self.queue.insert(next, first);
                    break;
                }
                // Its actor has stopped, which drops its lease too.
                Err(SendError::Closed(_)) => {}
            }
        }
    }

    /// Simulations with disconnected clients hold at most half of the slots, or one if there is only one.
    fn end_longest_away(&mut self) {
        if let Some(id) = longest_away(&self.present, (self.ports.len() / 2).max(1))
            && let Some(longest) = self.present.get_mut(&id)
        {
            longest.shown.away_until = None;
            longest.listener.do_send(SlotEvent::AwayTooLong);
        }
    }

    /// The lowest port that is neither leased nor used by another program.
    fn free_port(&self) -> Option<u16> {
        let taken: HashSet<u16> = self.present.values().flat_map(|one| [one.lent, one.shown.port]).flatten().collect();
        self.ports.clone().filter(|port| !taken.contains(port)).find(|port| is_free(*port))
    }

    fn instances(&self) -> Instances {
        let count = |stages: &[Stage]| {
            let matching = self.present.values().filter(|one| stages.contains(&one.shown.stage)).count();
            u32::try_from(matching).unwrap_or(u32::MAX)
        };
        Instances {
            queued: count(&[Stage::Queued]),
            starting: count(&[Stage::CheckingOut, Stage::Launching]),
            idle: count(&[Stage::Idle, Stage::Stopping]),
            running: count(&[Stage::Running]),
            places: u32::try_from(self.ports.len()).unwrap_or(u32::MAX),
            arrivals: self.arrivals,
        }
    }
}

/// Whether no program listens on a port, over IPv4 or IPv6; a machine may have only one of them.
fn is_free(port: u16) -> bool {
    let is_taken = |error: std::io::Error| error.kind() == ErrorKind::AddrInUse;
    TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
        && !TcpListener::bind((Ipv6Addr::UNSPECIFIED, port)).is_err_and(is_taken)
}

impl Actor for SlotPool {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.run_interval(RECHECK, |slots, _| slots.serve());
    }
}

impl Handler<Acquire> for SlotPool {
    type Result = ();

    fn handle(&mut self, Acquire(present): Acquire, _: &mut Self::Context) {
        self.arrivals += 1;
        let (id, parties, client) = (present.shown.id, present.parties(), present.listener.clone());
        let refusal = self.refusal(&parties);
        self.present.insert(id, *present);
        self.queue.push_back(Waiting { id, parties, client, sent_position: None });
        self.grant();
        if let Some(refusal) = refusal
            && let Some(refused) = self.queue.pop_back_if(|last| last.id == id)
        {
            self.present.remove(&id);
            refused.client.do_send(SlotEvent::Rejected(refusal));
        }
        self.serve();
    }
}

impl Handler<Release> for SlotPool {
    type Result = ();

    fn handle(&mut self, Release(id): Release, _: &mut Self::Context) {
        if let Some((present, ends)) = self.present.remove(&id).zip(self.ends.as_ref()) {
            ends.record(present.ended());
        }
        self.queue.retain(|waiting| waiting.id != id);
        self.serve();
    }
}

impl Handler<UpdateSimulation> for SlotPool {
    type Result = ();

    fn handle(&mut self, UpdateSimulation(id, report): UpdateSimulation, _: &mut Self::Context) {
        let is_away = matches!(report, Report::Change(SimulationChange::Away(Some(_))));
        if let Some(present) = self.present.get_mut(&id) {
            present.take(report);
        }
        if is_away {
            self.end_longest_away();
        }
    }
}

impl Handler<Move> for SlotPool {
    type Result = Result<(), SlotError>;

    fn handle(&mut self, Move { id, address }: Move, _: &mut Self::Context) -> Self::Result {
        let is_there = self.present.get(&id).is_none_or(|one| one.address == address);
        if let Some(party) = address.map(Party::Address).filter(|_| !is_there) {
            let has = self.share_of(&party);
            if has.slots >= self.shares.of(&party).slots {
                return Err(party.refusal(has));
            }
        }
        if let Some(present) = self.present.get_mut(&id) {
            present.address = address;
        }
        Ok(())
    }
}

impl Handler<StopOne> for SlotPool {
    type Result = bool;

    fn handle(&mut self, StopOne { id, why }: StopOne, _: &mut Self::Context) -> bool {
        let found = self.present.values().find(|one| one.shown.id.to_string() == id);
        found.inspect(|one| one.listener.do_send(SlotEvent::Stopped(why))).is_some()
    }
}

impl Handler<GetSnapshot> for SlotPool {
    type Result = Snapshot;

    fn handle(&mut self, _: GetSnapshot, _: &mut Self::Context) -> Snapshot {
        let simulations = self.present.values().map(|one| one.shown.clone()).collect();
        Snapshot { instances: self.instances(), simulations }
    }
}

impl SlotLease {
    /// Joins the queue for a slot. `listener` receives the events, `world` is shown, and the client counts for its address and
    /// its user.
    pub fn new(
        slots: &Addr<SlotPool>,
        listener: Recipient<SlotEvent>,
        world: &ProjectUrl,
        (client, identity): (Peer, ClientIdentity),
    ) -> Self {
        let id = SimulationId::next();
        slots.do_send(Acquire(Box::new(Present::new(id, world, (client, identity), listener))));
        Self { id, slots: slots.clone() }
    }

    /// The id of the simulation.
    pub fn id(&self) -> SimulationId {
        self.id
    }

    /// Reports a change of the simulation.
    pub fn update(&self, change: SimulationChange) {
        self.report(Report::Change(change));
    }

    /// Logs an event of the simulation under its id, and records it.
    pub fn log(&self, level: log::Level, event: String) {
        log::log!(target: "simulation", level, "{}: {event}", self.id);
        self.report(Report::Event(event));
    }

    /// Logs an event of the simulation under its id, and records what everybody may read of it.
    pub fn log_privately(&self, level: log::Level, event: &str, shown: String) {
        log::log!(target: "simulation", level, "{}: {event}", self.id);
        self.report(Report::Event(shown));
    }

    /// Reports how the simulation ends, before the lease is dropped. Only the first report counts.
    pub fn end(&self, reason: EndReason, why: &str, taken: Taken) {
        self.report(Report::End(End { reason, why: why.to_owned(), taken }));
    }

    fn report(&self, report: Report) {
        // The actor runs as long as the server; without it there is nothing to show.
        self.slots.do_send(UpdateSimulation(self.id, report));
    }
}

impl Drop for SlotLease {
    fn drop(&mut self) {
        self.slots.do_send(Release(self.id));
    }
}
