//! What the owner of a simulation holds: its slot, or its position in the queue for one.

use std::sync::Arc;

use actix::Recipient;

use super::present::{Access, Holder, Present, SlotEvent};
use super::slot_pool::SlotPool;
use crate::shared::domain::ProjectUrl;
use crate::shared::http::Peer;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{End, EndReason, Taken};
use crate::simulation::sessions::Token;
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
    /// Joins the queue for a slot. `listener` receives the events, `world` is shown, and the client counts for its address and
    /// its user.
    ///
    /// # Errors
    /// Why it may not wait, as text for the client.
    pub fn acquire(
        slots: &Arc<SlotPool>,
        id: SimulationId,
        listener: Recipient<SlotEvent>,
        world: &ProjectUrl,
        (client, identity): (Peer, ClientIdentity),
    ) -> Result<Self, String> {
        slots.acquire(Present::new(Simulation::new(id, world, identity), client, listener))?;
        Ok(Self {
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

    /// Logs an event of the simulation under its id, and records `shown`, the text that clients may read.
    pub fn log(&self, level: log::Level, event: &str, shown: &str) {
        log::log!(target: "simulation", level, "{}: {event}", self.id);
        self.slots.change(self.id, |present| present.note(shown));
    }

    /// Notes why the server is about to end the simulation: those at its streams are told when Webots closes these.
    pub fn ending(&self, why: &str) {
        self.slots.change(self.id, |present| {
            present.ending.get_or_init(|| why.to_owned());
        });
    }

    /// Reports how the simulation ends, before the lease is dropped. Only the first report counts. Its tokens become
    /// invalid, because another simulation may soon have its port.
    pub fn end(&self, reason: EndReason, why: &str, taken: Taken) {
        self.slots.change(self.id, |present| {
            present.accesses.clear();
            present.how.get_or_insert(End {
                reason,
                why: why.to_owned(),
                taken,
            });
        });
    }

    /// Opens the stream of the simulation, until its end is reported. Returns the token for its client.
    pub fn open_stream(&self) -> Token {
        let access = Access::new(Holder::Client);
        let token = access.token;
        self.slots.change(self.id, |present| present.accesses.push(access));
        token
    }
}

impl Drop for SlotLease {
    fn drop(&mut self) {
        self.slots.release(self.id);
    }
}
