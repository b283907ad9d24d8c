//! What the holder of a place, or of one in the line, hears.

use actix::prelude::*;

use super::slot_error::SlotError;

/// What the holder of a ticket hears.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum SlotEvent {
    /// So many clients are ahead in the waiting line.
    Queued(usize),
    /// This port may be used as long as the ticket lives.
    Granted(u16),
    /// There is no room in the waiting line either.
    Rejected(SlotError),
    /// Too many simulations wait for clients that are away, and this one has waited longest: it has to end.
    AwayTooLong,
    /// The administrator stops the simulation; the words are for its client.
    Stopped(String),
}
