//! What the owner of a simulation holds: its slot, or its position in the queue for one.

use actix::prelude::*;

use super::messages::{Acquire, Release, Update};
use super::present::Present;
use super::slot_event::SlotEvent;
use super::slot_pool::SlotPool;
use crate::shared::domain::ProjectUrl;
use crate::shared::http::Peer;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{End, EndReason, Taken};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::Simulation;

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

/// Changes what pages show of a simulation, if it has not ended.
pub fn update(slots: &Addr<SlotPool>, id: SimulationId, change: impl FnOnce(&mut Simulation) + Send + 'static) {
    slots.do_send(Update(id, Box::new(|present| change(&mut present.shown))));
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
        slots.do_send(Acquire(Box::new(Present::new(Simulation::new(id, world, identity), client, listener))));
        Self { id, slots: slots.clone() }
    }

    /// The id of the simulation.
    pub fn id(&self) -> SimulationId {
        self.id
    }

    /// Changes what pages show of the simulation.
    pub fn update(&self, change: impl FnOnce(&mut Simulation) + Send + 'static) {
        update(&self.slots, self.id, change);
    }

    /// Logs an event of the simulation under its id, and records what everybody may read of it.
    pub fn log(&self, level: log::Level, event: &str, shown: String) {
        log::log!(target: "simulation", level, "{}: {event}", self.id);
        self.slots.do_send(Update(self.id, Box::new(move |present| present.note(&shown))));
    }

    /// Reports how the simulation ends, before the lease is dropped. Only the first report counts.
    pub fn end(&self, reason: EndReason, why: &str, taken: Taken) {
        let end = End { reason, why: why.to_owned(), taken };
        let record = |present: &mut Present| {
            present.how.get_or_insert(end);
        };
        self.slots.do_send(Update(self.id, Box::new(record)));
    }
}

impl Drop for SlotLease {
    fn drop(&mut self) {
        self.slots.do_send(Release(self.id));
    }
}
