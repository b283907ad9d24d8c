//! Actor: leases slots to simulations, keeps the queue, and knows all simulations of this server.
//!
//! One for the whole server, created at start; it never ends. A slot is a streaming port. A session creates a
//! [`SlotLease`](super::SlotLease), and receives its position in the queue until a port is granted. Dropping the lease
//! leaves the queue or frees the port, so that neither leaks in any state or after any panic.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::RangeInclusive;
use std::time::Duration;

use actix::prelude::*;

use super::messages::{Acquire, GetSnapshot, Release, StopOne, Update};
use super::party::{Party, Share};
use super::present::Present;
use super::slot_event::SlotEvent;
use crate::shared::domain::Instances;
use crate::simulation::ends::Ends;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Snapshot, Stage};

/// The actor.
pub struct SlotPool {
    ports: RangeInclusive<u16>,
    queue_capacity: usize,
    per_address: Option<usize>,
    per_user: Option<usize>,
    /// Number of leases that were requested, including those of clients that were refused.
    arrivals: u64,
    /// All simulations in the order in which they were requested. Those without a port are the queue.
    present: BTreeMap<SimulationId, Present>,
    ends: Ends,
}

/// Interval between two checks of the ports that other programs have used.
const RECHECK: Duration = Duration::from_secs(1);

impl SlotPool {
    /// Leases these ports; `queue_capacity` clients may wait. One address and one user may have this many slots, and the
    /// same share of the queue; without a number, all of both. Each end is recorded with `ends`.
    pub fn new(
        ports: RangeInclusive<u16>,
        queue_capacity: usize,
        per_address: Option<usize>,
        per_user: Option<usize>,
        ends: Ends,
    ) -> Self {
        Self { ports, queue_capacity, per_address, per_user, arrivals: 0, present: BTreeMap::new(), ends }
    }

    fn queue(&self) -> impl Iterator<Item = &Present> {
        self.present.values().filter(|one| one.shown.port.is_none())
    }

    /// The first simulation in the queue whose client's address and user may have another slot.
    fn next_in_queue(&self) -> Option<SimulationId> {
        let mut lent: HashMap<Party, usize> = HashMap::new();
        for party in self.present.values().filter(|one| one.shown.port.is_some()).flat_map(Present::parties) {
            *lent.entry(party).or_default() += 1;
        }
        let may_have_one = |party: &Party| lent.get(party).is_none_or(|slots| *slots < self.limit(party).slots);
        self.queue().find(|waiting| waiting.parties().iter().all(may_have_one)).map(|waiting| waiting.shown.id)
    }

    /// What the clients of a party may have.
    fn limit(&self, party: &Party) -> Share {
        let slots = match party {
            Party::Address(_) => self.per_address,
            Party::User(_) => self.per_user,
        };
        let Some(slots) = slots else { return Share { slots: usize::MAX, waiting: usize::MAX } };
        let all = self.ports.len();
        Share { slots, waiting: (self.queue_capacity * slots.min(all)).div_ceil(all) }
    }

    /// What the clients of a party have.
    fn share_of(&self, party: &Party) -> Share {
        let present = self.present.values().filter(|one| one.parties().contains(party));
        let (lent, waiting): (Vec<_>, Vec<_>) = present.partition(|one| one.shown.port.is_some());
        Share { slots: lent.len(), waiting: waiting.len() }
    }

    /// Why another client of these parties may not wait, if so, as text for it.
    fn refusal(&self, parties: &[Party]) -> Option<String> {
        let mut shares = parties.iter().map(|party| (party, self.limit(party), self.share_of(party)));
        if let Some((party, _, has)) = shares.find(|(_, may, has)| may.is_used_up(*has)) {
            return Some(party.refusal(has));
        }
        let (places, waiting) = (self.ports.len(), self.queue().count());
        let full = || {
            format!(
                "All {places} places of this simulation server are taken, and {waiting} clients are waiting already. Try \
                 again later"
            )
        };
        (waiting >= self.queue_capacity).then(full)
    }

    /// Grants free slots to the clients in the queue, and sends the others their position.
    fn serve(&mut self) {
        self.grant();
        for (ahead, waiting) in self.present.values_mut().filter(|one| one.shown.port.is_none()).enumerate() {
            if waiting.sent_position.replace(ahead) != Some(ahead) {
                waiting.listener.do_send(SlotEvent::Queued(ahead));
            }
        }
    }

    fn grant(&mut self) {
        while let Some(next) = self.next_in_queue()
            && let Some(port) = self.free_port()
            && let Some(first) = self.present.get_mut(&next)
        {
            first.lend(port);
        }
    }

    /// Ends a simulation if those that wait for disconnected clients hold more than half of the slots: the one that has
    /// waited longest, among those of the address that has most of them, so that a client that reconnects often harms only
    /// itself.
    fn end_longest_away(&mut self) {
        let away: Vec<&Present> = self.present.values().filter(|one| one.shown.away_until.is_some()).collect();
        if away.len() <= (self.ports.len() / 2).max(1) {
            return;
        }
        let of_address = |address| away.iter().filter(|one| one.address() == address).count();
        let longest = away.iter().min_by_key(|one| (Reverse(of_address(one.address())), one.shown.away_until));
        if let Some(id) = longest.map(|one| one.shown.id)
            && let Some(longest) = self.present.get_mut(&id)
        {
            longest.shown.away_until = None;
            longest.listener.do_send(SlotEvent::AwayTooLong);
        }
    }

    /// The lowest port that is neither leased nor used by another program.
    fn free_port(&self) -> Option<u16> {
        let taken: HashSet<u16> = self.present.values().filter_map(|one| one.shown.port).collect();
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
        let (id, refusal) = (present.shown.id, self.refusal(&present.parties()));
        self.present.insert(id, *present);
        self.grant();
        if let Some(refusal) = refusal
            && self.present.get(&id).is_some_and(|one| one.shown.port.is_none())
            && let Some(refused) = self.present.remove(&id)
        {
            refused.listener.do_send(SlotEvent::Rejected(refusal));
        }
        self.serve();
    }
}

impl Handler<Release> for SlotPool {
    type Result = ();

    fn handle(&mut self, Release(id): Release, _: &mut Self::Context) {
        if let Some(present) = self.present.remove(&id) {
            self.ends.record(present.ended());
        }
        self.serve();
    }
}

impl Handler<Update> for SlotPool {
    type Result = ();

    fn handle(&mut self, Update(id, change): Update, _: &mut Self::Context) {
        if let Some(present) = self.present.get_mut(&id) {
            change(present);
            self.end_longest_away();
        }
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
