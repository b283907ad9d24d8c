//! The line of clients that wait for a slot of the fleet.
//!
//! - `ticket`: what a client keeps of its place;
//! - `waiting_line`: who waits, in the order of arrival;
//! - `classes`: who competes with whom;
//! - `link`: what one simulation server was asked for;
//! - `dispatcher`: who gets the next slot of which server;
//! - `rate`: how often slots become free, for the estimate.
//!
//! Nothing here reads a clock or does I/O: the caller passes the time. `docs/line.md` explains the rules.

mod classes;
mod dispatcher;
mod link;
mod rate;
mod ticket;
mod waiting_line;

pub use classes::Terms;
pub use dispatcher::{Dispatcher, Entered, LineStatus, Moment, Served, Turn, WaitingFor};
pub use ticket::Ticket;
pub use waiting_line::{Entry, Place, Position, WaitingClient};
