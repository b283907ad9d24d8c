//! The slots that clients wait for: leases, the queue, and the limit per address; the streams of simulations that have one.

mod present;
mod slot_lease;
mod slot_pool;
mod stream;

pub use present::SlotEvent;
pub use slot_lease::{Slot, SlotLease};
pub use slot_pool::SlotPool;
pub use stream::StreamTarget;
