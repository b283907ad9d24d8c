//! Simulations that are kept ready without a client: who takes one, and which one ends for whom. Part of the slot pool.
//!
//! Whether a client takes such a simulation or it ends is decided under the lock of the pool, once.

use std::collections::BTreeMap;

use actix::Recipient;

use super::simulation_record::{Client, HoldingState, Phase, SimulationRecord, SlotEvent, SpareKind, SpareState};
use super::slot_pool::{SlotPool, Slots, may_have, parties};
use crate::shared::domain::ReservationId;
use crate::shared::http::Peer;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::simulation_id::SimulationId;

/// A simulation without a client, for the one that keeps their number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpareStatus {
    /// The simulation.
    pub id: SimulationId,
    /// Whether its world is ready.
    pub is_ready: bool,
    /// Whether its branch has moved since.
    pub is_outdated: bool,
    /// Whether it, or its slot, is promised to a client.
    pub is_reserved: bool,
}

/// A client that may take one.
#[derive(Debug, Clone)]
pub struct Taker {
    /// What it asks for.
    pub kind: SpareKind,
    /// Its address.
    pub peer: Peer,
    /// Who it is.
    pub identity: ClientIdentity,
}

impl SimulationRecord {
    /// How far a simulation without a client has come; `None` if it has a client, or ends.
    fn progress(&self) -> Option<SpareStage> {
        let is_left = self.spare()?.state != SpareState::Ending && self.end.is_none();
        let progress = match &self.holding()?.state {
            HoldingState::CheckingOut | HoldingState::Preparing(_) => SpareStage::CheckingOut,
            HoldingState::Launched(launch) => match launch.phase {
                Phase::Launching => SpareStage::Launching,
                Phase::Ready { .. } => SpareStage::Ready,
                Phase::Stopping(_) => return None,
            },
        };
        is_left.then_some(progress)
    }

    fn is_of(&self, kind: &SpareKind) -> bool {
        self.spare().is_some_and(|spare| spare.kind == *kind)
    }

    /// Ends a simulation without a client, which then nobody takes any more.
    fn yield_slot(&mut self) {
        if let Some(spare) = self.spare_mut() {
            spare.state = SpareState::Ending;
            self.listener.do_send(SlotEvent::MakeRoom);
        }
    }
}

/// How far a simulation without a client has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum SpareStage {
    CheckingOut,
    Launching,
    Ready,
}

impl SlotPool {
    /// Gives a simulation that is kept ready to a client, if there is one for it: the one that has come furthest. A client
    /// with a reservation uses it by that. Returns where the session of the simulation is told, and a reservation for the
    /// client should the simulation have failed.
    pub fn take_spare(
        &self,
        taker: &Taker,
        reservation: Option<ReservationId>,
    ) -> Option<(Recipient<SlotEvent>, ReservationId)> {
        let mut slots = self.0.lock();
        let limits = (slots.per_address, slots.per_user);
        let parties = parties(taker.peer.rate_limit_key(), taker.identity.user.clone(), limits);
        let reserved = reservation.and_then(|id| slots.reservations.reserved.get(&id));
        let own = reserved.and_then(|reserved| reserved.held.spare());
        let counts_already = reserved.is_some_and(|reserved| reserved.parties == parties);
        let has_slot = reserved.is_some() || slots.offers_slot();
        if reservation.is_some() && reserved.is_none()
            || !has_slot
            || !counts_already && !may_have(&slots.lent(), &parties)
        {
            return None;
        }
        let id = own
            .filter(|id| slots.is_for(*id, &taker.kind))
            .or_else(|| slots.best_spare(&taker.kind))?;
        let reservation = reservation.map(|id| slots.reservations.redeem(id)).transpose().ok()?;
        slots.arrivals += 1;
        let mut client = Client::new(taker.peer, taker.identity.clone());
        client.parties = parties;
        client.since = reservation.map_or(client.since, |reservation| reservation.since);
        let record = slots.records.get_mut(&id)?;
        let again = ReservationId(rand::random());
        record.take(client, again);
        let session = record.listener.clone();
        slots.serve();
        Some((session, again))
    }

    /// The session of a simulation that was kept ready knows its client.
    pub fn taken(&self, id: SimulationId, again: ReservationId) {
        let mut slots = self.0.lock();
        if let Some(served) = slots.records.get_mut(&id).and_then(SimulationRecord::served_mut) {
            served.arriving = None;
        } else {
            // Its Webots has just ended, of which its client will hear.
            slots.reservations.reserved.remove(&again);
            slots.serve();
        }
    }

    /// Adds a simulation without a client, if a slot is free that no client waits for, and returns its port.
    pub(super) fn add_spare(&self, id: SimulationId, kind: SpareKind, listener: Recipient<SlotEvent>) -> Option<u16> {
        let mut slots = self.0.lock();
        let port = slots.free_port().filter(|_| slots.has_room_for_spare())?;
        slots
            .records
            .insert(id, SimulationRecord::for_spare(id, kind, port, listener));
        slots.serve();
        Some(port)
    }

    /// Whether there is a free slot that no client waits for.
    pub fn has_room_for_spare(&self) -> bool {
        let slots = self.0.lock();
        slots.has_room_for_spare() && slots.free_port().is_some()
    }

    /// The simulations without a client that are not ending, by what they are kept ready for.
    pub fn spares(&self) -> BTreeMap<SpareKind, Vec<SpareStatus>> {
        let slots = self.0.lock();
        let mut spares: BTreeMap<SpareKind, Vec<SpareStatus>> = BTreeMap::new();
        for record in slots.records.values() {
            let Some((spare, progress)) = record.spare().zip(record.progress()) else {
                continue;
            };
            let id = record.id;
            spares.entry(spare.kind.clone()).or_default().push(SpareStatus {
                id,
                is_ready: progress == SpareStage::Ready,
                is_outdated: spare.state == SpareState::Outdated,
                is_reserved: slots.reservations.holds(id),
            });
        }
        spares
    }

    /// The branch of these has moved: no client takes them any more.
    pub fn outdate_spares(&self, kind: &SpareKind) {
        let mut slots = self.0.lock();
        for record in slots.records.values_mut() {
            if let Some(spare) = record.spare_mut()
                && spare.kind == *kind
                && spare.state == SpareState::Current
            {
                spare.state = SpareState::Outdated;
            }
        }
    }

    /// Ends a simulation if it still is without a client, and promised to none.
    pub fn end_spare(&self, id: SimulationId) {
        let mut slots = self.0.lock();
        let is_promised = slots.reservations.holds(id);
        if let Some(record) = slots.records.get_mut(&id)
            && record.progress().is_some()
            && !is_promised
        {
            record.yield_slot();
        }
    }

    /// A simulation that was kept ready has failed. Returns whether no client is on its way; then none takes it any more.
    pub fn give_up_spare(&self, id: SimulationId) -> bool {
        let mut slots = self.0.lock();
        let Some(record) = slots.records.get_mut(&id) else {
            return !slots.reservations.expects_taker(id);
        };
        let spare = record.spare_mut();
        let has_no_client = spare.is_some();
        if let Some(spare) = spare {
            spare.state = SpareState::Ending;
        }
        has_no_client
    }
}

impl Slots {
    /// Whether no client waits, and those that are there run in real time.
    fn has_room_for_spare(&self) -> bool {
        self.offers_slot() && self.waiting() == 0
    }

    /// Whether a simulation is kept ready for this, and no other client has a better right to it.
    fn is_for(&self, id: SimulationId, kind: &SpareKind) -> bool {
        let record = self.records.get(&id);
        record.is_some_and(|record| record.progress().is_some() && record.is_of(kind) && !is_outdated(record))
    }

    /// The simulation that has come furthest of those that are kept ready for this, and not promised to a client.
    pub(super) fn best_spare(&self, kind: &SpareKind) -> Option<SimulationId> {
        let matching = self
            .records
            .iter()
            .filter(|(id, record)| record.is_of(kind) && !is_outdated(record) && !self.reservations.holds(**id));
        let by_progress = matching.filter_map(|(id, record)| Some((record.progress()?, std::cmp::Reverse(*id))));
        by_progress.max().map(|(_, id)| id.0)
    }

    /// The simulation without a client that ends first: one that is outdated, then the one that has come least far.
    pub(super) fn least_spare(&self) -> Option<SimulationId> {
        let free = self.records.iter().filter(|(id, _)| !self.reservations.holds(**id));
        let by_progress =
            free.filter_map(|(id, record)| Some((!is_outdated(record), record.progress()?, std::cmp::Reverse(*id))));
        by_progress.min().map(|(.., id)| id.0)
    }

    /// Ends a simulation without a client.
    pub(super) fn end_now(&mut self, id: SimulationId) {
        if let Some(record) = self.records.get_mut(&id) {
            record.yield_slot();
        }
    }
}

fn is_outdated(record: &SimulationRecord) -> bool {
    record.spare().is_some_and(|spare| spare.state == SpareState::Outdated)
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;
    use std::sync::Arc;
    use std::time::Duration;

    use actix::prelude::*;

    use super::*;
    use crate::shared::domain::{Failure, ProjectUrl, Reason, View};
    use crate::shared::http::Metrics;
    use crate::simulation::ends::Ends;
    use crate::simulation::slots::{QueuePosition, Slot};

    /// Hears nothing.
    struct Listener;

    impl Actor for Listener {
        type Context = Context<Self>;
    }

    impl Handler<SlotEvent> for Listener {
        type Result = ();

        fn handle(&mut self, _: SlotEvent, _: &mut Self::Context) {}
    }

    const PEER: Peer = Peer::Proxy(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST));

    fn pool() -> Arc<SlotPool> {
        let ends = Ends::start("/nonexistent".into(), String::new(), 12, &Metrics::default()).unwrap();
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        SlotPool::new(port..=port, 9, None, None, Duration::MAX, Duration::from_mins(1), ends)
    }

    fn kind() -> SpareKind {
        SpareKind {
            world: ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap(),
            view: View::default(),
        }
    }

    fn taker() -> Taker {
        Taker {
            kind: kind(),
            peer: PEER,
            identity: ClientIdentity::default(),
        }
    }

    /// The client of a simulation: since when it waits, and whether it has a slot.
    fn standing(pool: &SlotPool, id: SimulationId) -> (std::time::Instant, bool) {
        let slots = pool.0.lock();
        let record = &slots.records[&id];
        (record.client().unwrap().since, record.holding().is_some())
    }

    #[actix_rt::test]
    async fn who_takes_one_that_fails_at_that_moment_keeps_its_turn() {
        let pool = pool();
        let listener = Listener.start().recipient();
        let join = |id, reservation| {
            let client = (PEER, ClientIdentity::default());
            QueuePosition::join(&pool, id, listener.clone(), &kind().world, client, reservation)
        };
        let failed = SimulationId::next();
        let slot = Slot::for_spare(&pool, failed, listener.clone(), kind()).unwrap();
        let (_, again) = pool.take_spare(&taker(), None).unwrap();
        let (since, _) = standing(&pool, failed);
        // Others wait already when it fails.
        let other = SimulationId::next();
        let _waiting = join(other, None).ok().unwrap();
        slot.end(Failure::new(Reason::Crashed, "it has failed"));
        drop(slot);
        assert!(!pool.give_up_spare(failed), "its session waits for the client");
        assert!(!standing(&pool, other).1, "the slot is the first client's");
        let second = SimulationId::next();
        let position = join(second, Some(again)).ok().unwrap();
        assert_eq!(standing(&pool, second), (since, true));
        let instances = pool.instances();
        assert_eq!((instances.arrivals, instances.freed, instances.reserved), (2, 0, 0));
        drop(position);
        assert!(standing(&pool, other).1);
    }

    #[actix_rt::test]
    async fn what_its_client_has_taken_is_reserved_for_nobody_once_it_ends() {
        let pool = pool();
        let listener = Listener.start().recipient();
        for is_told_first in [true, false] {
            let id = SimulationId::next();
            let slot = Slot::for_spare(&pool, id, listener.clone(), kind()).unwrap();
            let (_, again) = pool.take_spare(&taker(), None).unwrap();
            if is_told_first {
                pool.taken(id, again);
                drop(slot);
            } else {
                // Its Webots ends just before its session hears of the client.
                drop(slot);
                pool.taken(id, again);
            }
            assert_eq!(pool.instances().reserved, 0);
            assert!(pool.give_up_spare(id));
        }
    }
}
