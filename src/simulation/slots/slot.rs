//! What the owner of a simulation holds: its position in the queue, and then its slot.

use std::path::PathBuf;
use std::sync::Arc;

use actix::Recipient;

use super::simulation_record::{Access, Client, Holder, OpenStream, Prepared, SimulationRecord, SlotEvent, SpareKind};
use super::slot_pool::SlotPool;
use crate::shared::domain::{Failure, ProjectUrl, ReservationId};
use crate::shared::http::Peer;
use crate::simulation::attachment::Token;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::End;
use crate::simulation::simulation_id::SimulationId;

/// A position in the queue for a slot. Dropping it leaves the queue, and frees the slot that it may have been granted.
pub struct QueuePosition(Entry);

/// A port for one simulation. Dropping it frees the port.
pub struct Slot {
    entry: Entry,
    /// The port on which Webots listens.
    pub port: u16,
}

/// A simulation in the pool. Dropping it removes the simulation.
struct Entry {
    id: SimulationId,
    slots: Arc<SlotPool>,
}

impl QueuePosition {
    /// Joins the queue for a slot, or takes the one that is reserved for the client. `listener` receives the events, `world`
    /// is shown, and the client counts for its address and its user.
    ///
    /// # Errors
    /// Why it may not wait.
    pub fn join(
        slots: &Arc<SlotPool>,
        id: SimulationId,
        listener: Recipient<SlotEvent>,
        world: &ProjectUrl,
        (peer, identity): (Peer, ClientIdentity),
        reservation: Option<ReservationId>,
    ) -> Result<Self, Failure> {
        slots.acquire((id, world), Client::new(peer, identity), listener, reservation)?;
        Ok(Self(Entry {
            id,
            slots: Arc::clone(slots),
        }))
    }

    /// The slot that it was granted.
    pub fn granted(self, port: u16) -> Slot {
        Slot { entry: self.0, port }
    }

    /// Reports how the simulation ends, before this is dropped. Only the first report counts.
    pub fn end(&self, end: impl Into<End>) {
        self.0.end(end.into());
    }
}

impl Slot {
    /// Takes a free slot for a simulation that is kept ready for clients; `None` if there is none that no client waits
    /// for.
    pub fn for_spare(
        slots: &Arc<SlotPool>,
        id: SimulationId,
        listener: Recipient<SlotEvent>,
        kind: SpareKind,
    ) -> Option<Self> {
        let port = slots.add_spare(id, kind, listener)?;
        let entry = Entry {
            id,
            slots: Arc::clone(slots),
        };
        Some(Self { entry, port })
    }

    /// The id of the simulation.
    pub fn id(&self) -> SimulationId {
        self.entry.id
    }

    /// Logs an event of the simulation under its id, and records `note`, the text that clients may read.
    pub fn log(&self, level: log::Level, event: &str, note: &str) {
        log::log!(target: "simulation", level, "{}: {event}", self.entry.id);
        self.entry.change(|record| record.note(note));
    }

    /// Its world is checked out.
    pub fn prepared(&self, prepared: Prepared) {
        self.entry.change(|record| record.prepare(prepared));
    }

    /// Its Webots was launched as the process `pid`, whose output is kept in the file `log`.
    pub fn launched(&self, pid: i32, log: Option<PathBuf>) {
        self.entry.change(|record| record.launch(pid, log));
    }

    /// Opens the stream of the simulation, until its end is reported. Returns the token for its
    /// client. `answers_controllers`: its Webots tells controllers whether it has a world.
    pub fn open_stream(&self, answers_controllers: bool, is_running: bool) -> Token {
        let access = Access::new(Holder::Client);
        let token = access.token;
        let stream = OpenStream {
            answers_controllers,
            accesses: vec![access],
        };
        self.entry.change(|record| record.open_stream(stream, is_running));
        token
    }

    /// The simulation is paused, or goes on.
    pub fn set_running(&self, is_running: bool) {
        self.entry.change(|record| record.set_running(is_running));
    }

    /// Notes why the server is about to end the simulation: those at its streams are told when Webots closes these.
    pub fn ending(&self, why: &str) {
        self.entry.change(|record| {
            record.ending.get_or_init(|| why.to_owned());
        });
    }

    /// Its Webots ends.
    pub fn stopping(&self) {
        self.entry.change(SimulationRecord::stop);
    }

    /// Reports how the simulation ends, before this is dropped. Only the first report counts. Its tokens become invalid.
    pub fn end(&self, end: impl Into<End>) {
        self.entry.end(end.into());
    }
}

impl Entry {
    fn change(&self, change: impl FnOnce(&mut SimulationRecord)) {
        self.slots.change(self.id, change);
    }

    fn end(&self, end: End) {
        self.change(|record| record.end(end));
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.slots.release(self.id);
    }
}
