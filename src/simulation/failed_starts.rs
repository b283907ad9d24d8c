//! Counts the last starts that failed for a reason of this server's own, so that session servers prefer others.

use std::sync::atomic::{AtomicU32, Ordering};

/// How many starts in a row have failed for a reason of this server's own. A start that failed for its world's or its
/// client's reason leaves the count as it is.
#[derive(Debug, Default)]
pub struct FailedStarts(AtomicU32);

impl FailedStarts {
    /// Counts a failed start.
    pub fn add(&self, why: &str) {
        let count = self.0.fetch_add(1, Ordering::Relaxed) + 1;
        log::warn!("a start has failed for a reason of this server's own, {count} in a row: {why}");
    }

    /// Forgets them: a start has succeeded, or what was wrong with the server is repaired.
    pub fn reset(&self) {
        self.0.store(0, Ordering::Relaxed);
    }

    /// How many there were in a row.
    #[must_use]
    pub fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}
