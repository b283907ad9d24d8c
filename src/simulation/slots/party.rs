//! Clients that share slots: those of one address, and those of one user.

use std::net::IpAddr;

/// An address, or a user whose name a trusted reverse proxy sends.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Party {
    Address(IpAddr),
    User(String),
}

/// How many slots a party has or may have, and how many of its clients wait or may wait.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    pub slots: usize,
    pub waiting: usize,
}

impl Share {
    /// Whether a party with this share may have no further client.
    pub(super) fn is_used_up(self, has: Self) -> bool {
        has.waiting >= self.waiting && (has.slots >= self.slots || has.waiting > 0)
    }
}

impl Party {
    /// Why it gets no other slot, as text for the client: it has so many, and so many of its clients wait.
    pub(super) fn refusal(&self, Share { slots, waiting }: Share) -> String {
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
