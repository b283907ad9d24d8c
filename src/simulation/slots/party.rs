//! Clients that share slots: those of one address, and those of one user.

use std::net::IpAddr;

/// An address, or a user whose name a trusted reverse proxy sends.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Party {
    Address(IpAddr),
    User(String),
}

impl Party {
    /// Why it gets no other slot, as text for the client: it has so many, and so many of its clients wait.
    pub(super) fn refusal(&self, slots: usize, waiting: usize) -> String {
        let (have, more) = match self {
            Self::Address(_) => ("Clients of your address have", "more"),
            Self::User(_) => ("You have", "more clients of yours"),
        };
        format!(
            "{have} {slots} places of this simulation server, and {waiting} {more} are waiting. The rest is kept for \
             others. Try again later"
        )
    }
}
