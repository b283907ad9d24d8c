//! Leases slots to simulations, keeps the queue, and knows all simulations of this server.
//!
//! One for the whole server. A slot is a streaming port. A session creates a [`SlotLease`](super::SlotLease), and
//! receives its position in the queue until a port is granted. Dropping the lease leaves the queue or frees the port, so
//! that neither leaks in any state or after any panic.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;

use super::simulation_record::{Party, SimulationRecord, SlotEvent};
use crate::shared::domain::{Failure, Instances, Reason};
use crate::simulation::ends::Ends;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Simulation, Snapshot, Stage};

/// The slots of this server, and the simulations that have one or wait for record.
pub struct SlotPool(pub(super) Mutex<Slots>);

pub(super) struct Slots {
    ports: RangeInclusive<u16>,
    queue_capacity: usize,
    per_address: Option<usize>,
    per_user: Option<usize>,
    /// Number of leases that were requested, including those of clients that were refused.
    arrivals: u64,
    /// All simulations in the order in which they were requested. Those without a port are the queue.
    pub(super) records: BTreeMap<SimulationId, SimulationRecord>,
    ends: Ends,
}

/// Interval between two checks of the ports that other programs have used.
const RECHECK: Duration = Duration::from_secs(1);

impl SlotPool {
    /// Leases these ports; `queue_capacity` clients may wait. `per_address` and `per_user` limit the slots of one
    /// address and one user, and likewise their waiting clients. Each end is recorded with `ends`.
    pub fn new(
        ports: RangeInclusive<u16>,
        queue_capacity: usize,
        per_address: Option<usize>,
        per_user: Option<usize>,
        ends: Ends,
    ) -> Arc<Self> {
        Arc::new(Self(Mutex::new(Slots {
            ports,
            queue_capacity,
            per_address,
            per_user,
            arrivals: 0,
            records: BTreeMap::new(),
            ends,
        })))
    }

    /// Checks every second whether ports that other programs used are free again, and grants them.
    pub async fn recheck(self: Arc<Self>) {
        loop {
            actix_rt::time::sleep(RECHECK).await;
            self.0.lock().serve();
        }
    }

    /// Adds a simulation to the queue, and grants it a slot if it is its turn.
    ///
    /// # Errors
    /// Why it may not wait: the slots and the queue are full, or its address or its user has reached its limit.
    pub(super) fn acquire(&self, mut record: SimulationRecord) -> Result<(), Failure> {
        let mut slots = self.0.lock();
        slots.arrivals += 1;
        let address = record
            .client
            .rate_limit_key()
            .map(Party::Address)
            .zip(slots.per_address);
        let user = record
            .simulation
            .identity
            .user
            .clone()
            .map(Party::User)
            .zip(slots.per_user);
        record.parties = address.into_iter().chain(user).collect();
        let id = record.simulation.id;
        let refusal = slots.refusal(&record);
        slots.records.insert(id, record);
        slots.grant();
        if let Some(refusal) = refusal
            && slots.queue().any(|record| record.simulation.id == id)
        {
            slots.records.remove(&id);
            return Err(refusal);
        }
        slots.serve();
        Ok(())
    }

    /// Frees the slot of a simulation, or its position in the queue.
    pub(super) fn release(&self, id: SimulationId) {
        let mut slots = self.0.lock();
        if let Some(record) = slots.records.remove(&id) {
            slots.ends.record(record.ended());
        }
        slots.serve();
    }

    /// Changes the record of a simulation, if it has not ended.
    pub(super) fn change(&self, id: SimulationId, change: impl FnOnce(&mut SimulationRecord)) {
        if let Some(record) = self.0.lock().records.get_mut(&id) {
            change(record);
        }
    }

    /// Changes what pages show of a simulation, if it has not ended.
    pub fn update(&self, id: SimulationId, change: impl FnOnce(&mut Simulation)) {
        self.change(id, |record| change(&mut record.simulation));
    }

    /// Stops the simulation with this id; `why` is the text for its client. Returns whether there is record.
    pub fn stop(&self, id: &str, why: String) -> bool {
        let slots = self.0.lock();
        let found = slots
            .records
            .values()
            .find(|record| record.simulation.id.to_string() == id);
        found
            .inspect(|record| record.listener.do_send(SlotEvent::Stopped(why)))
            .is_some()
    }

    /// The numbers of simulations by state.
    pub fn instances(&self) -> Instances {
        self.0.lock().instances()
    }

    /// All simulations at this moment.
    pub fn snapshot(&self) -> Snapshot {
        let slots = self.0.lock();
        let simulations = slots.records.values().map(|record| record.simulation.clone()).collect();
        Snapshot {
            instances: slots.instances(),
            simulations,
        }
    }
}

impl Slots {
    fn queue(&self) -> impl Iterator<Item = &SimulationRecord> {
        self.records.values().filter(|record| record.simulation.port.is_none())
    }

    /// The simulations in the queue whose client's address and user may have another slot.
    fn eligible(&self) -> impl Iterator<Item = &SimulationRecord> {
        let mut lent: HashMap<&Party, usize> = HashMap::new();
        for (party, _) in self
            .records
            .values()
            .filter(|record| record.simulation.port.is_some())
            .flat_map(|record| &record.parties)
        {
            *lent.entry(party).or_default() += 1;
        }
        self.queue().filter(move |waiting| {
            let may_have_one = |(party, most): &(Party, usize)| lent.get(party).is_none_or(|slots| slots < most);
            waiting.parties.iter().all(may_have_one)
        })
    }

    fn next_in_queue(&self) -> Option<SimulationId> {
        self.eligible().next().map(|next| next.simulation.id)
    }

    /// Why one more simulation may not wait; `None` if it may.
    fn refusal(&self, record: &SimulationRecord) -> Option<Failure> {
        for party in &record.parties {
            let waiting = self.queue().filter(|record| record.parties.contains(party)).count();
            // Even with a high limit, a party leaves a part of the queue to others.
            if waiting >= party.1.min((self.queue_capacity * 3 / 4).max(1)) {
                let all = self
                    .records
                    .values()
                    .filter(|record| record.parties.contains(party))
                    .count();
                return Some(party.0.refusal(all - waiting, waiting));
            }
        }
        let slots = self.ports.len();
        let waiting = self.queue().count();
        (waiting >= self.queue_capacity).then(|| {
            let message = format!(
                "All {slots} places of this simulation server are taken, and {waiting} clients are waiting already. Try \
                 again later"
            );
            Failure::new(Reason::QueueFull, message)
        })
    }

    /// Grants free slots to the clients in the queue, makes room for the others, and sends them their position.
    fn serve(&mut self) {
        self.grant();
        self.make_room();
        for (ahead, waiting) in self
            .records
            .values_mut()
            .filter(|record| record.simulation.port.is_none())
            .enumerate()
        {
            if waiting.sent_position.replace(ahead) != Some(ahead) {
                waiting.listener.do_send(SlotEvent::Queued(ahead));
            }
        }
    }

    fn grant(&mut self) {
        while let Some(next) = self.next_in_queue()
            && let Some(port) = self.free_port()
            && let Some(first) = self.records.get_mut(&next)
        {
            first.lend(port);
        }
    }

    /// While clients wait because all slots are taken, ends simulations that wait for their own clients: one for each, the
    /// longest absent first, of addresses for which more than a quarter of the slots waits. So somebody who leaves one
    /// simulation after the other can't keep all slots.
    fn make_room(&mut self) {
        let waiting = self.eligible().count();
        if waiting == 0 || self.free_port().is_some() {
            return;
        }
        let leaving = self
            .records
            .values()
            .filter(|record| record.is_away() && record.makes_room);
        for _ in leaving.count()..waiting {
            let Some(longest_away) = self.longest_away() else {
                return;
            };
            longest_away.makes_room = true;
            longest_away.listener.do_send(SlotEvent::MakeRoom);
        }
    }

    /// The simulation that waits for its client the longest, of addresses for which more than their share waits.
    fn longest_away(&mut self) -> Option<&mut SimulationRecord> {
        let share = (self.ports.len() / 4).max(1);
        let mut away: HashMap<IpAddr, usize> = HashMap::new();
        let address = |record: &SimulationRecord| {
            record
                .client
                .rate_limit_key()
                .filter(|_| record.is_away() && !record.makes_room)
        };
        for address in self.records.values().filter_map(address) {
            *away.entry(address).or_default() += 1;
        }
        let has_too_many =
            |record: &&mut SimulationRecord| address(record).is_some_and(|address| away.get(&address) > Some(&share));
        self.records
            .values_mut()
            .filter(has_too_many)
            .min_by_key(|record| record.simulation.away_until)
    }

    /// The lowest port that is neither leased nor used by another program.
    fn free_port(&self) -> Option<u16> {
        let taken: HashSet<u16> = self
            .records
            .values()
            .filter_map(|record| record.simulation.port)
            .collect();
        self.ports.clone().find(|port| !taken.contains(port) && is_free(*port))
    }

    fn instances(&self) -> Instances {
        let count = |stages: &[Stage]| {
            let matching = self
                .records
                .values()
                .filter(|record| stages.contains(&record.simulation.stage))
                .count();
            u32::try_from(matching).unwrap_or(u32::MAX)
        };
        Instances {
            queued: count(&[Stage::Queued]),
            starting: count(&[Stage::CheckingOut, Stage::Launching]),
            idle: count(&[Stage::Idle, Stage::Stopping]),
            running: count(&[Stage::Running]),
            places: u32::try_from(self.ports.len()).unwrap_or(u32::MAX),
            arrivals: self.arrivals,
            ..Instances::default()
        }
    }
}

/// Whether no program listens on a port, over IPv4 or IPv6; a machine may have only one of them.
fn is_free(port: u16) -> bool {
    let is_taken = |error: std::io::Error| error.kind() == ErrorKind::AddrInUse;
    TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
        && !TcpListener::bind((Ipv6Addr::UNSPECIFIED, port)).is_err_and(is_taken)
}
