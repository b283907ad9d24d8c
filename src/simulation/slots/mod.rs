//! The slots that clients wait for: leases, the queue, and the limit per address.

mod party;
mod present;
mod slot_event;
mod slot_lease;
mod slot_pool;

pub use slot_event::SlotEvent;
pub use slot_lease::{Slot, SlotLease};
pub use slot_pool::SlotPool;
