//! The places that clients wait for: who has one, who is next, and how many one address may have.

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
