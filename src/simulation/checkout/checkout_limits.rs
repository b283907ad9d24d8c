//! Limits of a checkout. Pure.

use std::time::Duration;

/// Limits of a checkout.
#[derive(Debug, Clone, Copy)]
pub struct CheckoutLimits {
    /// Timeout of a whole checkout: the fetch, the copy and large files.
    pub time: Duration,
    /// Size limit of a fetch, and of a checkout, in bytes. Each file and directory counts at least the space of its
    /// entry.
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
