//! The streams of running simulations: who may have one, and who watches.

mod streams;

pub use streams::{Found, Registration, Streams, Watched, Watching};
