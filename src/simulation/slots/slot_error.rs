//! Why a client gets no place.

/// Why there is no place. The words are for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SlotError {
    /// Everything is taken, the waiting line too.
    #[error(
        "All {places} places of this simulation server are taken, and {waiting} clients are waiting already. Try again later"
    )]
    QueueFull {
        /// Places in all.
        places: usize,
        /// Length of the waiting line.
        waiting: usize,
    },
    /// The client's address has its share.
    #[error(
        "Clients of your address have {places} places of this simulation server, and {waiting} more are waiting. The rest \
         is kept for others. Try again later"
    )]
    AddressLimit {
        /// Places that the address has.
        places: usize,
        /// Clients of the address that wait.
        waiting: usize,
    },
    /// The client's user has its share.
    #[error(
        "You have {places} places of this simulation server, and {waiting} more clients of yours are waiting. The rest is \
         kept for others. Try again later"
    )]
    ShareOfUser {
        /// Places that the user has.
        places: usize,
        /// Clients of the user that wait.
        waiting: usize,
    },
}
