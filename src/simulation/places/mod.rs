//! The places that clients wait for: who has one, who is next, and how many one address may have.

mod messages;
mod no_place;
mod party;
mod place_event;
mod places;
mod present;

pub use messages::{GetSnapshot, Move, StopOne, Update};
pub use no_place::NoPlace;
pub use place_event::PlaceEvent;
pub use places::{Places, Ticket};
pub use present::Report;
