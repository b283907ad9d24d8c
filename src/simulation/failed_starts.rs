//! Counts consecutive starts that failed for a reason of this server's own, so that session servers prefer other
//! servers.

use std::sync::atomic::{AtomicU32, Ordering};

/// Number of consecutive starts that failed for a reason of this server's own. A start that failed for its world's or
/// its client's reason does not change it.
#[derive(Debug, Default)]
pub struct FailedStarts(AtomicU32);

impl FailedStarts {
    /// Counts a failed start.
    pub fn add(&self, why: &str) {
        let count = self.0.fetch_add(1, Ordering::Relaxed) + 1;
        log::warn!("a start has failed for a reason of this server's own, {count} in a row: {why}");
    }

    /// Resets the count: a start has succeeded, or the server's problem is solved.
    pub fn reset(&self) {
        self.0.store(0, Ordering::Relaxed);
    }

    /// The number in a row.
    pub fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}
