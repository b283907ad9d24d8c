//! The events of a lease.

use actix::prelude::*;

/// An event of a lease.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum SlotEvent {
    /// This many clients are ahead in the queue.
    Queued(usize),
    /// This port may be used until the lease is dropped.
    Granted(u16),
    /// The first watcher of the simulation connects, or the last one leaves.
    Watched(bool),
    /// The administrator stops the simulation; the words are for its client.
    Stopped(String),
}
