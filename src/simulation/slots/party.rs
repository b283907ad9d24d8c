//! Clients that share slots: those of one address, and those of one user.

use std::net::IpAddr;

use super::slot_error::SlotError;

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

/// What one party may have.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shares {
    pub address: Share,
    pub user: Share,
}

impl Share {
    /// This many of all slots, and the same part of the queue; without a number, as many as there are.
    pub(super) fn new(slots: Option<usize>, all: usize, queue_capacity: usize) -> Self {
        let Some(slots) = slots else { return Self { slots: usize::MAX, waiting: usize::MAX } };
        let all = all.max(1);
        Self { slots, waiting: (queue_capacity * slots.min(all)).div_ceil(all) }
    }

    /// Whether a party with this share may have no further client.
    pub(super) fn is_used_up(self, has: Self) -> bool {
        has.waiting >= self.waiting && (has.slots >= self.slots || has.waiting > 0)
    }
}

impl Shares {
    pub(super) fn of(self, party: &Party) -> Share {
        match party {
            Party::Address(_) => self.address,
            Party::User(_) => self.user,
        }
    }
}

impl Party {
    /// Why it gets no other slot: it has so many, and so many of its clients wait.
    pub(super) fn refusal(&self, Share { slots: places, waiting }: Share) -> SlotError {
        match self {
            Self::Address(_) => SlotError::AddressLimit { places, waiting },
            Self::User(_) => SlotError::UserLimit { places, waiting },
        }
    }
}
