//! The streams of running simulations, and the tokens that lead to them.

mod streams;

pub use streams::{StreamRegistration, StreamTarget, Streams, WatchGuard, Watched};
