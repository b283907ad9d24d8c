//! The slots that clients wait for: leases, the queue, and the limit per address.

mod messages;
mod party;
mod present;
mod slot_event;
mod slot_lease;
mod slot_pool;

pub use messages::{GetSnapshot, StopOne};
pub use slot_event::SlotEvent;
pub use slot_lease::{Slot, SlotLease, update};
pub use slot_pool::SlotPool;
