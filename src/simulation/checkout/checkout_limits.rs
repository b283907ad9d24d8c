//! What a checkout may take. Pure.

use std::time::Duration;

/// What a checkout may take.
#[derive(Debug, Clone, Copy)]
pub struct CheckoutLimits {
    /// Time limit of a whole checkout: the fetch, the copy and large files.
    pub time: Duration,
    /// In bytes: what is fetched, and what is checked out. Each file and folder counts at least what it takes of a disk.
    pub size: u64,
    /// Whether any commit may be fetched by its hash, not only those of branches and tags.
    pub any_commit: bool,
}

impl CheckoutLimits {
    /// How long a remote may be silent, and packing a cached repository hold a fetch up.
    pub fn stall_timeout(&self) -> Duration {
        self.time / 4
    }
}
