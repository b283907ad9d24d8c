//! By what clients count together who share the places: their address, and their user.

use std::net::IpAddr;

use super::slot_error::SlotError;

/// An address, or a user whom a trusted web server names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Party {
    Address(IpAddr),
    User(String),
}

/// What one party may have: so many places, and so many of its clients may wait. `None` for as many as there are.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Shares {
    pub address: Option<(usize, usize)>,
    pub user: Option<(usize, usize)>,
}

impl Shares {
    pub(super) fn of(self, party: &Party) -> Option<(usize, usize)> {
        match party {
            Party::Address(_) => self.address,
            Party::User(_) => self.user,
        }
    }

    pub(super) fn are_none(self) -> bool {
        self.address.is_none() && self.user.is_none()
    }
}

impl Party {
    /// Why it gets no other place: it has so many, and so many of its clients wait.
    pub(super) fn refusal(&self, (places, waiting): (usize, usize)) -> SlotError {
        match self {
            Self::Address(_) => SlotError::AddressLimit { places, waiting },
            Self::User(_) => SlotError::ShareOfUser { places, waiting },
        }
    }
}
