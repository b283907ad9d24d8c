//! Leases slots to simulations, keeps the queue, and knows all simulations of this server.
//!
//! One for the whole server. A slot is a streaming port. A session creates a [`SlotLease`](super::SlotLease), and
//! receives its position in the queue until a port is granted. Dropping the lease leaves the queue or frees the port, so
//! that neither leaks in any state or after any panic.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::party::Party;
use super::present::Present;
use super::slot_event::SlotEvent;
use crate::shared::domain::Instances;
use crate::simulation::ends::Ends;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Simulation, Snapshot, Stage};

/// The slots of this server, and the simulations that have one or wait for one.
pub struct SlotPool(Mutex<Slots>);

pub(super) struct Slots {
    ports: RangeInclusive<u16>,
    queue_capacity: usize,
    per_address: Option<usize>,
    per_user: Option<usize>,
    /// Number of leases that were requested, including those of clients that were refused.
    arrivals: u64,
    /// All simulations in the order in which they were requested. Those without a port are the queue.
    pub(super) present: BTreeMap<SimulationId, Present>,
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
    ) -> Arc<Self> {
        let present = BTreeMap::new();
        Arc::new(Self(Mutex::new(Slots { ports, queue_capacity, per_address, per_user, arrivals: 0, present, ends })))
    }

    pub(super) fn slots(&self) -> MutexGuard<'_, Slots> {
        // After a panic the server ends: `recheck` notices it.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Checks again each second which ports other programs have left. Ends once a panic has left the slots in disorder.
    pub async fn recheck(self: Arc<Self>) {
        while !self.0.is_poisoned() {
            actix_rt::time::sleep(RECHECK).await;
            self.slots().serve();
        }
    }

    /// Has a simulation wait for a slot, and grants it one if it is its turn.
    ///
    /// # Errors
    /// Why it may not wait, as text for the client: the slots and the queue are full, or its address or its user has
    /// reached its limit.
    pub(super) fn acquire(&self, present: Present) -> Result<(), String> {
        let mut slots = self.slots();
        slots.arrivals += 1;
        let (id, refusal) = (present.shown.id, slots.refusal(&present.parties()));
        slots.present.insert(id, present);
        slots.grant();
        if let Some(refusal) = refusal
            && slots.queue().any(|one| one.shown.id == id)
        {
            slots.present.remove(&id);
            return Err(refusal);
        }
        slots.serve();
        Ok(())
    }

    /// Frees the slot of a simulation, or its position in the queue.
    pub(super) fn release(&self, id: SimulationId) {
        let mut slots = self.slots();
        if let Some(present) = slots.present.remove(&id) {
            slots.ends.record(present.ended());
        }
        slots.serve();
    }

    /// Changes the record of a simulation, if it has not ended.
    pub(super) fn change(&self, id: SimulationId, change: impl FnOnce(&mut Present)) {
        let mut slots = self.slots();
        if let Some(present) = slots.present.get_mut(&id) {
            change(present);
            slots.end_longest_away();
        }
    }

    /// Changes what pages show of a simulation, if it has not ended.
    pub fn update(&self, id: SimulationId, change: impl FnOnce(&mut Simulation)) {
        self.change(id, |present| change(&mut present.shown));
    }

    /// Stops the simulation that has this id now, and no other one: `why` is for its client. Returns whether there is
    /// one.
    pub fn stop(&self, id: &str, why: String) -> bool {
        let slots = self.slots();
        let found = slots.present.values().find(|one| one.shown.id.to_string() == id);
        found.inspect(|one| one.listener.do_send(SlotEvent::Stopped(why))).is_some()
    }

    /// The numbers of simulations by state.
    pub fn instances(&self) -> Instances {
        self.slots().instances()
    }

    /// All simulations at this moment.
    pub fn snapshot(&self) -> Snapshot {
        let slots = self.slots();
        let simulations = slots.present.values().map(|one| one.shown.clone()).collect();
        Snapshot { instances: slots.instances(), simulations }
    }
}

impl Slots {
    fn queue(&self) -> impl Iterator<Item = &Present> {
        self.present.values().filter(|one| one.shown.port.is_none())
    }

    /// The first simulation in the queue whose client's address and user may have another slot.
    fn next_in_queue(&self) -> Option<SimulationId> {
        let mut lent: HashMap<Party, usize> = HashMap::new();
        for party in self.present.values().filter(|one| one.shown.port.is_some()).flat_map(Present::parties) {
            *lent.entry(party).or_default() += 1;
        }
        let may_have_one = |party: &Party| {
            let slots = lent.get(party).copied().unwrap_or_default();
            self.limit(party).is_none_or(|most| slots < most)
        };
        self.queue().find(|waiting| waiting.parties().iter().all(may_have_one)).map(|waiting| waiting.shown.id)
    }

    /// How many slots the clients of a party may have; `None` for all of them.
    fn limit(&self, party: &Party) -> Option<usize> {
        match party {
            Party::Address(_) => self.per_address,
            Party::User(_) => self.per_user,
        }
    }

    /// Why another client of this party may not wait, if so: the party has its slots, or its clients wait for them, and as
    /// many wait as in its share of the queue.
    fn refusal_of(&self, party: &Party) -> Option<String> {
        let (most, all) = (self.limit(party)?, self.ports.len());
        let present = self.present.values().filter(|one| one.parties().contains(party));
        let (lent, waiting): (Vec<_>, Vec<_>) = present.partition(|one| one.shown.port.is_some());
        let (lent, waiting) = (lent.len(), waiting.len());
        let is_used_up = waiting >= (self.queue_capacity * most.min(all)).div_ceil(all);
        (is_used_up && (lent >= most || waiting > 0)).then(|| party.refusal(lent, waiting))
    }

    /// Why another client of these parties may not wait, if so, as text for it.
    fn refusal(&self, parties: &[Party]) -> Option<String> {
        if let Some(refusal) = parties.iter().find_map(|party| self.refusal_of(party)) {
            return Some(refusal);
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
