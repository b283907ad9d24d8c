//! The places that clients wait for: who has one, who is next, and how many one address may have.

mod no_place;
mod places;
mod present;

pub use places::{GetSnapshot, PlaceEvent, Places, Ticket};
