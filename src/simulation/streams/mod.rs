//! The streams of running simulations: their tokens, and their watchers.

mod streams;

pub use streams::{Found, Registration, Streams, Watched, Watching};
