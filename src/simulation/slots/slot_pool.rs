//! Grants slots to simulations, keeps the queue, and knows all simulations of this server.
//!
//! One for the whole server. A slot is a streaming port. A session creates a [`QueuePosition`](super::QueuePosition), which
//! becomes a [`Slot`](super::Slot) once a port is granted. Dropping either leaves the queue or frees the port, so that neither
//! leaks in any state or after any panic.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::net::IpAddr;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::Recipient;
use parking_lot::Mutex;

use super::port;
use super::real_time_places::RealTimePlaces;
use super::reservations::{Held, LinkId, Reservations, Reserved};
use super::simulation_record::{
    Away, Client, Holding, Party, Served, SimulationRecord, SlotEvent, SpareKind, Standing,
};
use crate::shared::domain::{Failure, Instances, ProjectUrl, Reason, ReservationId, Stage, View, Wish, Wishes};
use crate::simulation::ends::Ends;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{Holdings, Snapshot};

/// The slots of this server, and the simulations that have one or wait for one.
pub struct SlotPool(pub(super) Mutex<Slots>);

pub(super) struct Slots {
    ports: RangeInclusive<u16>,
    queue_capacity: usize,
    pub(super) per_address: Option<usize>,
    pub(super) per_user: Option<usize>,
    /// How long a client may be away before its simulation gives its slot to one that waits.
    yield_after: Duration,
    /// Number of clients that have asked for a slot, including those that were refused.
    pub(super) arrivals: u64,
    /// Number of simulations that have given their slots back.
    freed: u64,
    /// The slots that are reserved for clients of session servers' lines.
    pub(super) reservations: Reservations,
    /// How many of the slots are offered, as far as simulations run in real time.
    pub(super) real_time: RealTimePlaces,
    /// All simulations in the order in which they were requested. Those without a port are the queue.
    pub(super) records: BTreeMap<SimulationId, SimulationRecord>,
    ends: Ends,
    /// What processes of this server have that serve their last clients.
    others: Holdings,
    /// The ports that are left once another process has all others.
    left: Option<BTreeSet<u16>>,
}

/// Interval between two checks of reservations.
const EXPIRY: Duration = Duration::from_millis(100);
/// Interval between two checks of the ports that other programs have used.
const RECHECK: Duration = Duration::from_secs(1);

impl SlotPool {
    /// Lends these ports; `queue_capacity` clients may wait. `per_address` and `per_user` limit the slots of one
    /// address and one user, and likewise their waiting clients. A simulation whose client is away for `yield_after` gives
    /// its slot to a client that waits. A reservation holds for the time `pass`. Each end is recorded with `ends`.
    pub fn new(
        ports: RangeInclusive<u16>,
        queue_capacity: usize,
        per_address: Option<usize>,
        per_user: Option<usize>,
        yield_after: Duration,
        pass: Duration,
        ends: Ends,
    ) -> Arc<Self> {
        Arc::new(Self(Mutex::new(Slots {
            ports,
            queue_capacity,
            per_address,
            per_user,
            yield_after,
            arrivals: 0,
            freed: 0,
            reservations: Reservations::new(pass),
            real_time: RealTimePlaces::default(),
            records: BTreeMap::new(),
            ends,
            others: Holdings::default(),
            left: None,
        })))
    }

    /// Checks every second whether ports that other programs used are free again, and grants them; and more often
    /// whether reservations have expired.
    pub async fn recheck(self: Arc<Self>) {
        let mut checked = Instant::now();
        loop {
            actix_rt::time::sleep(EXPIRY).await;
            let mut slots = self.0.lock();
            let now = Instant::now();
            if slots.reservations.expire(now) || now.duration_since(checked) >= RECHECK {
                checked = now;
                slots.serve();
            }
        }
    }

    /// Other processes of this server have these ports and simulations, and no others.
    pub fn set_others(&self, others: Holdings) {
        let mut slots = self.0.lock();
        slots.others = others;
        slots.serve();
    }

    /// Another process has all ports from now on, except those that are taken here, until they are free. Returns what is
    /// left here.
    pub fn supersede(&self) -> Holdings {
        {
            let mut slots = self.0.lock();
            slots.left = Some(slots.taken().collect());
            slots.others = Holdings::default();
        }
        self.give_up_free()
    }

    /// Whether another process has the ports that become free.
    pub fn is_superseded(&self) -> bool {
        self.0.lock().left.is_some()
    }

    /// Gives up the slots that have become free and that nobody here waits for: another process may use them from now on.
    /// Returns what this process has.
    pub fn give_up_free(&self) -> Holdings {
        let mut slots = self.0.lock();
        if slots.left.is_some() && slots.queue().next().is_none() {
            slots.left = Some(slots.taken().collect());
        }
        Holdings {
            ports: slots.left.clone().unwrap_or_else(|| slots.taken().collect()),
            instances: slots.own_instances(),
            simulations: slots.of_clients().map(SimulationRecord::shown).collect(),
        }
    }

    /// Whether this process has no simulation, none waits, and no slot is reserved.
    pub fn is_empty(&self) -> bool {
        let slots = self.0.lock();
        slots.records.is_empty() && slots.reservations.reserved.is_empty()
    }

    /// Whether this process has the simulation with this id.
    pub fn has(&self, id: &str) -> bool {
        self.0.lock().of_clients().any(|record| record.id.to_string() == id)
    }

    /// A session server has connected, for whose line slots are reserved.
    pub fn open_link(&self, id: LinkId, listener: Recipient<Reserved>) {
        let mut slots = self.0.lock();
        slots.reservations.open(id, listener);
        slots.serve();
    }

    /// A session server has left.
    pub fn close_link(&self, id: LinkId) {
        let mut slots = self.0.lock();
        slots.reservations.close(id);
        slots.serve();
    }

    /// These clients of a session server want slots, and no others.
    pub fn wish(&self, id: LinkId, wishes: &Wishes) {
        let mut slots = self.0.lock();
        let limits = (slots.per_address, slots.per_user);
        let parties = |wish: &Wish| parties(wish.address, wish.user.clone(), limits);
        slots.reservations.wish(id, wishes, parties);
        slots.serve();
    }

    /// No slots are reserved any more for clients of a session server.
    pub fn clear_wishes(&self, id: LinkId) {
        self.0.lock().reservations.clear(id);
    }

    /// Adds a simulation to the queue, and grants it a slot if it is its turn.
    ///
    /// # Errors
    /// Why it may not wait: the slots and the queue are full, or its address or its user has reached its limit.
    pub(super) fn acquire(
        &self,
        (id, world): (SimulationId, &ProjectUrl),
        mut client: Client,
        listener: Recipient<SlotEvent>,
        reservation: Option<ReservationId>,
    ) -> Result<(), Failure> {
        let mut slots = self.0.lock();
        let reservation = reservation.map(|id| slots.reservations.redeem(id)).transpose()?;
        // A client that was about to take a simulation that was kept ready was counted then.
        let is_new = reservation
            .as_ref()
            .is_none_or(|reservation| reservation.link().is_some());
        slots.arrivals += u64::from(is_new);
        let limits = (slots.per_address, slots.per_user);
        client.parties = parties(client.address(), client.identity.user.clone(), limits);
        let own = client.parties.clone();
        client.since = reservation
            .as_ref()
            .map_or(client.since, |reservation| reservation.since);
        let mut record = SimulationRecord::for_client(id, world, client, listener);
        if let Some(reservation) = reservation {
            // It may count for somebody else than the session server knew.
            if own == reservation.parties || may_have(&slots.lent(), &own) {
                match reservation.held {
                    Held::Port(port) => record.lend(port),
                    // It is of another kind than the client: the client gets its port.
                    Held::Spare(spare) => slots.end_now(spare),
                }
                slots.records.insert(id, record);
                slots.serve();
                return Ok(());
            }
        }
        let refusal = slots.refusal(&own);
        slots.records.insert(id, record);
        slots.grant();
        if let Some(refusal) = refusal
            && slots.queue().any(|(waiting, _)| waiting == id)
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
            if let Some(Holding { port, .. }) = record.holding() {
                let port = *port;
                slots.reservations.keep_port(id, port);
                match record.served() {
                    Some(Served {
                        client,
                        arriving: Some(reservation),
                        ..
                    }) => slots.reservations.keep_for(*reservation, id, port, client),
                    Some(_) => slots.freed += 1,
                    None => {}
                }
                log::info!(target: "simulation", "{id}: the slot of port {port} is free");
            }
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

    /// Records until when the client of a simulation, which has gone, may come back; `None`: it is there.
    pub fn mark_away(&self, id: SimulationId, until: Option<u64>) {
        self.change(id, |record| record.set_away(until));
    }

    /// Stops the simulations with these ids; `why` is the text for their clients. Returns the ids of those that are there.
    pub fn stop(&self, ids: &[String], why: &str) -> Vec<String> {
        let slots = self.0.lock();
        let with_ids = slots.records.values().map(|record| (record.id.to_string(), record));
        let chosen = with_ids.filter(|(id, _)| ids.contains(id));
        let stopped = chosen.map(|(id, record)| {
            record.listener.do_send(SlotEvent::Stopped(why.to_owned()));
            id
        });
        stopped.collect()
    }

    /// The numbers of simulations by state.
    pub fn instances(&self) -> Instances {
        self.0.lock().instances()
    }

    /// All simulations at this moment, those of processes that serve their last clients first.
    pub fn snapshot(&self) -> Snapshot {
        let slots = self.0.lock();
        let others = slots.others.simulations.iter().cloned();
        Snapshot {
            instances: slots.instances(),
            simulations: others.chain(slots.of_clients().map(SimulationRecord::shown)).collect(),
        }
    }
}

impl Slots {
    /// The simulations that have a client.
    pub(super) fn of_clients(&self) -> impl Iterator<Item = &SimulationRecord> {
        self.records.values().filter(|record| record.spare().is_none())
    }

    fn queue(&self) -> impl Iterator<Item = (SimulationId, &Client)> {
        self.records
            .values()
            .filter_map(|record| Some((record.id, record.waiting()?)))
    }

    /// The simulations in the queue whose client's address and user may have another slot.
    fn eligible(&self) -> impl Iterator<Item = (SimulationId, &Client)> {
        let lent = self.lent();
        self.queue().filter(move |(_, client)| may_have(&lent, &client.parties))
    }

    /// Number of slots that each address and user has whose slots are limited.
    pub(super) fn lent(&self) -> HashMap<Party, usize> {
        let mut lent: HashMap<Party, usize> = HashMap::new();
        let of_records = self
            .records
            .values()
            .filter_map(SimulationRecord::served)
            .flat_map(|served| &served.client.parties);
        let of_reservations = self.reservations.reserved.values().flat_map(|one| &one.parties);
        for (party, _) in of_records.chain(of_reservations) {
            *lent.entry(party.clone()).or_default() += 1;
        }
        lent
    }

    /// Who gets the next slot: of those in the queue and in the lines of session servers, the one that came first.
    fn next(&self) -> Option<Next> {
        let lent = self.lent();
        let in_line = self.reservations.first(|parties| may_have(&lent, parties));
        let in_queue = self
            .queue()
            .filter(|(_, client)| may_have(&lent, &client.parties))
            .map(|(id, client)| {
                let is_behind = self.reservations.is_behind(client.address());
                ((is_behind, client.since), id)
            })
            .min();
        match (in_line, in_queue) {
            (Some((link, index, order)), queue) if queue.is_none_or(|(other, _)| order < other) => {
                Some(Next::InLine(link, index))
            }
            (_, Some((_, id))) => Some(Next::InQueue(id)),
            (_, None) => None,
        }
    }

    /// Why one more client that counts for these may not wait; `None` if it may.
    fn refusal(&self, parties: &[(Party, usize)]) -> Option<Failure> {
        for party in parties {
            let waiting = self
                .queue()
                .filter(|(_, client)| client.parties.contains(party))
                .count();
            // Even with a high limit, a party leaves a part of the queue to others.
            if waiting >= party.1.min((self.queue_capacity * 3 / 4).max(1)) {
                let clients = self.records.values().filter_map(SimulationRecord::client);
                let all = clients.filter(|client| client.parties.contains(party)).count();
                return Some(party.0.refusal(all - waiting, waiting));
            }
        }
        let slots = self.places();
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
    pub(super) fn serve(&mut self) {
        self.grant();
        self.make_room();
        let queue: Vec<Instant> = self.queue().map(|(_, client)| client.since).collect();
        let free = self.places().saturating_sub(self.used());
        let lent = self.lent();
        let has_share = |(party, most): &(Party, usize)| lent.get(party).is_some_and(|slots| slots >= most);
        self.reservations.tell(free, &queue, has_share);
        let mut before = 0;
        for record in self.records.values_mut() {
            let Standing::Waiting { client, told } = &mut record.standing else {
                continue;
            };
            let ahead = before + self.reservations.ahead_of(client.since);
            if told.replace(ahead) != Some(ahead) {
                record.listener.do_send(SlotEvent::Queued(ahead));
            }
            before += 1;
        }
    }

    /// The slots of this server.
    pub(super) fn all_places(&self) -> usize {
        self.ports.len()
    }

    /// The slots that are offered: all, or as many as run in real time.
    fn places(&self) -> usize {
        let all = self.all_places();
        self.real_time.places().map_or(all, |places| places.min(all))
    }

    /// The slots that clients have, or that are reserved for them, or that other processes of this server have. That of a
    /// simulation without a client is as good as free, unless it is promised.
    pub(super) fn used(&self) -> usize {
        let of_clients = self.records.values().filter_map(SimulationRecord::served);
        of_clients.count() + self.reservations.reserved.len() + self.others.ports.len()
    }

    /// Whether another client may have a slot, which may be that of a simulation without a client.
    pub(super) fn offers_slot(&self) -> bool {
        self.used() < self.places()
    }

    fn grant(&mut self) {
        while self.offers_slot()
            && let Some(next) = self.next()
        {
            match next {
                Next::InLine(link, index) => {
                    let Some(held) = self.to_hold(link, index) else { return };
                    self.reservations.reserve(link, index, held);
                }
                Next::InQueue(id) => {
                    let Some(port) = self.free_port() else { return };
                    if let Some(first) = self.records.get_mut(&id) {
                        first.lend(port);
                    }
                }
            }
        }
    }

    /// What is reserved for a client in a line: a simulation that is kept ready for it, a free port, or the slot of
    /// another simulation without a client, which ends once the client comes.
    fn to_hold(&self, link: LinkId, index: usize) -> Option<Held> {
        let kind = self.reservations.world(link, index).map(|world| SpareKind {
            world: world.clone(),
            // A client in the line does not say how it will show its world.
            view: View::default(),
        });
        let own = kind.and_then(|kind| self.best_spare(&kind)).map(Held::Spare);
        own.or_else(|| self.free_port().map(Held::Port))
            .or_else(|| self.least_spare().map(Held::Spare))
    }

    /// Number of clients that wait for a slot, and may have one.
    pub(super) fn waiting(&self) -> usize {
        let lent = self.lent();
        self.eligible().count() + self.reservations.waiting(|parties| may_have(&lent, parties))
    }

    /// While clients wait because all slots are taken, ends others: one for each, first those that are kept ready without
    /// a client, then simulations that wait for their own clients: the longest absent first, of those absent for
    /// `yield_after`, and of addresses for which more than a quarter of the slots waits. So somebody who leaves one
    /// simulation after the other can't keep all slots.
    fn make_room(&mut self) {
        let waiting = self.waiting();
        let offers_slot = self.offers_slot();
        if waiting == 0 || offers_slot && self.free_port().is_some() {
            return;
        }
        let leaving = self.records.values().filter(|record| record.makes_room());
        for _ in leaving.count()..waiting {
            // Where no slot is offered, theirs would help nobody.
            if offers_slot && let Some(spare) = self.least_spare() {
                self.end_now(spare);
                continue;
            }
            let Some((listener, away)) = self.longest_away() else {
                return;
            };
            away.makes_room = true;
            listener.do_send(SlotEvent::MakeRoom);
        }
    }

    /// The simulation that waits for its client the longest, if that is too long, or more than the share of its address
    /// waits.
    fn longest_away(&mut self) -> Option<(Recipient<SlotEvent>, &mut Away)> {
        let share = (self.ports.len() / 4).max(1);
        let mut of_addresses: HashMap<IpAddr, usize> = HashMap::new();
        let served = self.records.values().filter_map(SimulationRecord::served);
        let clients = served.map(|served| &served.client);
        let waiting = clients.filter(|client| client.away.is_some_and(|away| !away.makes_room));
        for address in waiting.filter_map(Client::address) {
            *of_addresses.entry(address).or_default() += 1;
        }
        let yield_after = self.yield_after;
        let away = self.records.values_mut().filter_map(|record| {
            let listener = record.listener.clone();
            let Client { peer, away, .. } = &mut record.served_mut()?.client;
            let address = peer.rate_limit_key();
            let away = away.as_mut().filter(|away| !away.makes_room)?;
            let is_long = away.since.elapsed() >= yield_after;
            let is_one_of_many = address.is_some_and(|address| of_addresses.get(&address) > Some(&share));
            (is_long || is_one_of_many).then_some((listener, away))
        });
        away.min_by_key(|(_, away)| away.since)
    }

    /// The ports that simulations have, or that are reserved.
    fn taken(&self) -> impl Iterator<Item = u16> {
        let lent = self.records.values().filter_map(|record| Some(record.holding()?.port));
        let reserved = self.reservations.reserved.values().filter_map(|one| match one.held {
            Held::Port(port) => Some(port),
            Held::Spare(_) => None,
        });
        lent.chain(reserved)
    }

    /// The lowest port that is neither lent nor reserved nor that of another process of this server, nor used by another
    /// program.
    pub(super) fn free_port(&self) -> Option<u16> {
        let taken: HashSet<u16> = self.taken().collect();
        let is_others = |port: &u16| {
            let has_left = self.left.as_ref().is_some_and(|left| !left.contains(port));
            has_left || self.others.ports.contains(port)
        };
        self.ports
            .clone()
            .find(|port| !taken.contains(port) && !is_others(port) && port::is_free(*port))
    }

    fn instances(&self) -> Instances {
        let mut instances = self.own_instances();
        instances.add(&self.others.instances);
        instances
    }

    fn own_instances(&self) -> Instances {
        let count = |stages: &[Stage]| {
            let matching = self
                .of_clients()
                .filter(|record| stages.contains(&record.stage()))
                .count();
            u32::try_from(matching).unwrap_or(u32::MAX)
        };
        Instances {
            queued: count(&[Stage::Queued]),
            starting: count(&[Stage::CheckingOut, Stage::Launching]),
            idle: count(&[Stage::Idle, Stage::Stopping]),
            running: count(&[Stage::Running]),
            slots: u32::try_from(self.places()).unwrap_or(u32::MAX),
            arrivals: self.arrivals,
            reserved: u32::try_from(self.reservations.reserved.len()).unwrap_or(u32::MAX),
            freed: self.freed,
            spare: u32::try_from(self.records.values().filter(|record| record.spare().is_some()).count())
                .unwrap_or(u32::MAX),
        }
    }
}

/// Who gets the next slot.
enum Next {
    /// A simulation in the queue.
    InQueue(SimulationId),
    /// A client in the line of a session server.
    InLine(LinkId, usize),
}

/// The address and the user of a client, if their slots are limited, each with its limit.
pub(super) fn parties(
    address: Option<IpAddr>,
    user: Option<String>,
    (per_address, per_user): (Option<usize>, Option<usize>),
) -> Vec<(Party, usize)> {
    let address = address.map(Party::Address).zip(per_address);
    let user = user.map(Party::User).zip(per_user);
    address.into_iter().chain(user).collect()
}

/// Whether these may have another slot.
pub(super) fn may_have(lent: &HashMap<Party, usize>, parties: &[(Party, usize)]) -> bool {
    let is_left = |(party, most): &(Party, usize)| lent.get(party).is_none_or(|slots| slots < most);
    parties.iter().all(is_left)
}

#[cfg(test)]
mod tests {
    use actix::prelude::*;
    use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

    use super::*;
    use crate::shared::http::{Metrics, Peer};
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::slots::QueuePosition;

    /// Passes on that its simulation is to make room.
    struct Listener(UnboundedSender<()>);

    impl Actor for Listener {
        type Context = Context<Self>;
    }

    impl Handler<SlotEvent> for Listener {
        type Result = ();

        fn handle(&mut self, event: SlotEvent, _: &mut Self::Context) {
            if matches!(event, SlotEvent::MakeRoom) {
                self.0.send(()).unwrap();
            }
        }
    }

    #[actix_rt::test]
    async fn who_comes_back_before_it_makes_room_makes_room_the_next_time() {
        let ends = Ends::start("/nonexistent".into(), String::new(), 12, &Metrics::default()).unwrap();
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        let pool = SlotPool::new(
            port..=port,
            1,
            None,
            None,
            Duration::ZERO,
            Duration::from_secs(10),
            ends,
        );
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
        let (sender, mut told) = unbounded_channel();
        let listener = Listener(sender).start();
        let ids = [SimulationId::next(), SimulationId::next()];
        let _positions = ids.map(|id| {
            let client = (
                Peer::Proxy(std::net::Ipv4Addr::LOCALHOST.into()),
                ClientIdentity::default(),
            );
            let position = QueuePosition::join(&pool, id, listener.clone().recipient(), &world, client, None);
            position.ok().unwrap()
        });
        // The second client waits for the slot of the first.
        for _ in 0..2 {
            pool.mark_away(ids[0], Some(0));
            pool.0.lock().serve();
            let made = actix_rt::time::timeout(Duration::from_secs(10), told.recv()).await;
            assert_eq!(made, Ok(Some(())));
            // It does not hear that before it is back.
            pool.mark_away(ids[0], None);
        }
    }
}
