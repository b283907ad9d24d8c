//! Simulations that are kept ready without a client: who takes one, and which one ends for whom. Part of the slot pool.
//!
//! Whether a client takes such a simulation or it ends is decided under the lock of the pool, once.

use std::collections::BTreeMap;

use actix::Recipient;

use super::simulation_record::{RunsFor, SimulationRecord, SlotEvent, SpareKind};
use super::slot_pool::{SlotPool, Slots, may_have, parties};
use crate::shared::domain::ReservationId;
use crate::shared::domain::Stage;
use crate::shared::http::Peer;
use crate::shared::run::seconds_since_1970;
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
    fn progress(&self) -> Option<Progress> {
        let is_left = self.spare().is_some() && !self.makes_room && self.end.is_none();
        match self.simulation.stage {
            Stage::Idle | Stage::Running if is_left => Some(Progress::Ready),
            Stage::Launching if is_left => Some(Progress::Launching),
            Stage::CheckingOut if is_left => Some(Progress::CheckingOut),
            _ => None,
        }
    }

    fn is_of(&self, kind: &SpareKind) -> bool {
        self.spare().is_some_and(|spare| spare.kind == *kind)
    }

    /// Ends a simulation without a client, which then nobody takes any more.
    fn yield_slot(&mut self) {
        self.makes_room = true;
        self.listener.do_send(SlotEvent::MakeRoom);
    }
}

/// How far a simulation without a client has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Progress {
    CheckingOut,
    Launching,
    Ready,
}

impl SlotPool {
    /// Gives a simulation that is kept ready to a client, if there is one for it: the one that has come furthest. A client
    /// with a reservation uses it by that. Returns where the session of the simulation is told.
    pub fn take_spare(&self, taker: &Taker, reservation: Option<ReservationId>) -> Option<Recipient<SlotEvent>> {
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
        let record = slots.records.get_mut(&id)?;
        record.runs_for = RunsFor::Client(taker.peer);
        record.parties = parties;
        record.since = reservation.map_or_else(std::time::Instant::now, |reservation| reservation.since);
        let now = seconds_since_1970();
        let simulation = &mut record.simulation;
        simulation.identity = taker.identity.clone();
        simulation.since = now;
        simulation.waited = Some(record.since.elapsed().as_secs_f64());
        // The time limit of a simulation that is kept ready begins with its client.
        simulation.launched = simulation.launched.map(|_| now);
        record.note("a client takes it; it was kept ready");
        let session = record.listener.clone();
        slots.serve();
        Some(session)
    }

    /// Adds a simulation without a client, if a slot is free that no client waits for. Returns whether it was added.
    pub(super) fn add_spare(&self, mut record: SimulationRecord) -> bool {
        let mut slots = self.0.lock();
        let Some(port) = slots.free_port().filter(|_| slots.has_room_for_spare()) else {
            return false;
        };
        record.lend(port);
        slots.records.insert(record.simulation.id, record);
        slots.serve();
        true
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
            let id = record.simulation.id;
            spares.entry(spare.kind.clone()).or_default().push(SpareStatus {
                id,
                is_ready: progress == Progress::Ready,
                is_outdated: spare.is_outdated,
                is_reserved: slots.reservations.holds(id),
            });
        }
        spares
    }

    /// The branch of these has moved: no client takes them any more.
    pub fn outdate_spares(&self, kind: &SpareKind) {
        let mut slots = self.0.lock();
        for record in slots.records.values_mut() {
            if let RunsFor::Spare(spare) = &mut record.runs_for
                && spare.kind == *kind
            {
                spare.is_outdated = true;
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

    /// A simulation that was kept ready has failed. Returns whether it has no client; then it gets none any more.
    pub fn give_up_spare(&self, id: SimulationId) -> bool {
        let mut slots = self.0.lock();
        let Some(record) = slots.records.get_mut(&id) else {
            return true;
        };
        record.makes_room = record.spare().is_some();
        record.makes_room
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
    record.spare().is_some_and(|spare| spare.is_outdated)
}
