//! All simulations of the fleet, and all who wait for one: the list that administrators see and act on.

mod roster;

pub use roster::{Changes, ClassEntry, ClassState, Key, Matching, Roster, RosterTooLarge, StopRequest, Watching};
