//! Why a client gets no slot.

/// Why a client gets no slot. The messages are for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SlotError {
    /// All slots are taken, and the queue is full.
    #[error(
        "All {places} places of this simulation server are taken, and {waiting} clients are waiting already. Try again later"
    )]
    QueueFull {
        /// Number of slots.
        places: usize,
        /// Length of the queue.
        waiting: usize,
    },
    /// The client's address has reached its limit.
    #[error(
        "Clients of your address have {places} places of this simulation server, and {waiting} more are waiting. The rest \
         is kept for others. Try again later"
    )]
    AddressLimit {
        /// Number of slots that the address has.
        places: usize,
        /// Number of clients of the address that wait.
        waiting: usize,
    },
    /// The client's user has reached its limit.
    #[error(
        "You have {places} places of this simulation server, and {waiting} more clients of yours are waiting. The rest is \
         kept for others. Try again later"
    )]
    UserLimit {
        /// Number of slots that the user has.
        places: usize,
        /// Number of clients of the user that wait.
        waiting: usize,
    },
}
