//! The slots that clients wait for: leases, the queue, and the limit per address.

mod messages;
mod party;
mod present;
mod slot_error;
mod slot_event;
mod slot_pool;

pub use messages::{GetSnapshot, Move, StopOne, UpdateSimulation};
pub use present::Report;
pub use slot_error::SlotError;
pub use slot_event::SlotEvent;
pub use slot_pool::{Slot, SlotLease, SlotPool};
