//! The signal that wakes the eviction of cached repositories.

use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::Notify;

/// Wakes the eviction of the cache.
#[derive(Debug, Default)]
pub struct EvictionSignal {
    over_budget: AtomicBool,
    changed: Notify,
}

impl EvictionSignal {
    /// Signals that a repository has grown.
    pub fn grown(&self) {
        self.changed.notify_one();
    }

    /// Records whether the cache exceeds its budget.
    pub fn set_over_budget(&self, is_over: bool) {
        self.over_budget.store(is_over, Ordering::Relaxed);
    }

    /// Signals that a repository is no longer in use, if the cache exceeds its budget.
    pub fn left(&self) {
        if self.over_budget.load(Ordering::Relaxed) {
            self.changed.notify_one();
        }
    }

    /// Waits until a repository may have to be evicted.
    pub async fn changed(&self) {
        self.changed.notified().await;
    }
}
