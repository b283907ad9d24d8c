//! The slots that clients wait for, the queue, and the limits per address and user; the streams of simulations.

pub mod port;
mod real_time;
mod real_time_places;
mod reservations;
mod simulation_record;
mod slot;
mod slot_pool;
mod spare;
mod stream;

pub use reservations::{LinkId, Reserved};
pub use simulation_record::{Prepared, SlotEvent, SpareKind};
pub use slot::{QueuePosition, Slot};
pub use slot_pool::SlotPool;
pub use spare::{SpareStatus, Taker};
pub use stream::StreamTarget;
