//! Who has a token that leads to the stream of a simulation.

use std::time::{Duration, Instant};

use crate::simulation::sessions::Token;

/// Timeout of a watcher's token that is not used. A used one is valid as long as its connection.
pub(super) const TOKEN_TIMEOUT: Duration = Duration::from_mins(1);

/// A token that leads to the stream of a simulation.
pub(super) struct Access {
    pub token: Token,
    pub holder: Holder,
}

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Holder {
    /// The client of the simulation.
    Client,
    /// Somebody who may watch, and got the token at this time.
    Invited(Instant),
    /// Somebody who watches.
    Watcher,
}

impl Access {
    /// Whether the token is still valid.
    pub fn is_valid(&self) -> bool {
        !matches!(self.holder, Holder::Invited(at) if at.elapsed() >= TOKEN_TIMEOUT)
    }
}
