//! What the owner of a simulation holds: its slot, or its position in the queue for one.

use std::sync::Arc;

use actix::Recipient;

use super::simulation_record::{Access, Holder, SimulationRecord, SlotEvent, SpareKind};
use super::slot_pool::SlotPool;
use crate::shared::domain::{Failure, ProjectUrl, ReservationId};
use crate::shared::http::Peer;
use crate::simulation::attachment::Token;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::End;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::Simulation;

/// A slot, or a position in the queue for one. Dropping it releases it.
pub struct SlotLease {
    id: SimulationId,
    slots: Arc<SlotPool>,
}

/// A port for one simulation, with its lease.
pub struct Slot {
    /// Frees the slot when it is dropped.
    pub lease: SlotLease,
    /// The port on which Webots listens.
    pub port: u16,
}

impl SlotLease {
    /// Joins the queue for a slot, or takes the one that is reserved for the client. `listener` receives the events, `world`
    /// is shown, and the client counts for its address and its user.
    ///
    /// # Errors
    /// Why it may not wait.
    pub fn acquire(
        slots: &Arc<SlotPool>,
        id: SimulationId,
        listener: Recipient<SlotEvent>,
        world: &ProjectUrl,
        (client, identity): (Peer, ClientIdentity),
        reservation: Option<ReservationId>,
    ) -> Result<Self, Failure> {
        let record = SimulationRecord::for_client(Simulation::new(id, world, identity), client, listener);
        slots.acquire(record, reservation)?;
        Ok(Self {
            id,
            slots: Arc::clone(slots),
        })
    }

    /// Takes a free slot for a simulation that is kept ready for clients; `None` if there is none that no client waits
    /// for.
    pub fn for_spare(
        slots: &Arc<SlotPool>,
        id: SimulationId,
        listener: Recipient<SlotEvent>,
        kind: SpareKind,
    ) -> Option<Self> {
        let simulation = Simulation::new(id, &kind.world, ClientIdentity::default());
        let record = SimulationRecord::for_spare(simulation, kind, listener);
        slots.add_spare(record).then(|| Self {
            id,
            slots: Arc::clone(slots),
        })
    }

    /// The id of the simulation.
    pub fn id(&self) -> SimulationId {
        self.id
    }

    /// Changes what pages show of the simulation.
    pub fn update(&self, change: impl FnOnce(&mut Simulation)) {
        self.slots.update(self.id, change);
    }

    /// Logs an event of the simulation under its id, and records `note`, the text that clients may read.
    pub fn log(&self, level: log::Level, event: &str, note: &str) {
        log::log!(target: "simulation", level, "{}: {event}", self.id);
        self.slots.change(self.id, |record| record.note(note));
    }

    /// Notes why the server is about to end the simulation: those at its streams are told when Webots closes these.
    pub fn ending(&self, why: &str) {
        self.slots.change(self.id, |record| {
            record.ending.get_or_init(|| why.to_owned());
        });
    }

    /// Reports how the simulation ends, before the lease is dropped. Only the first report counts. Its tokens become
    /// invalid, because another simulation may soon have its port.
    pub fn end(&self, end: impl Into<End>) {
        self.slots.change(self.id, |record| {
            record.accesses.clear();
            record.end.get_or_insert_with(|| end.into());
        });
    }

    /// Opens the stream of the simulation, until its end is reported. Returns the token for its
    /// client. `answers_controllers`: its Webots tells controllers whether it has a world.
    pub fn open_stream(&self, answers_controllers: bool) -> Token {
        let access = Access::new(Holder::Client);
        let token = access.token;
        self.slots.change(self.id, |record| {
            record.answers_controllers = answers_controllers;
            record.accesses.push(access);
        });
        token
    }
}

impl Drop for SlotLease {
    fn drop(&mut self) {
        self.slots.release(self.id);
    }
}
