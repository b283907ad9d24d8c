//! How the cache learns that it may have something to remove.

use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::Notify;

/// Tells the cache that it may have something to remove.
#[derive(Debug, Default)]
pub struct EvictionSignal {
    over_budget: AtomicBool,
    changed: Notify,
}

impl EvictionSignal {
    /// A repository has grown.
    pub fn grown(&self) {
        self.changed.notify_one();
    }

    /// Notes whether the cache is larger than its budget.
    pub fn set_over_budget(&self, is_over: bool) {
        self.over_budget.store(is_over, Ordering::Relaxed);
    }

    /// A repository is no longer in use.
    pub fn left(&self) {
        if self.over_budget.load(Ordering::Relaxed) {
            self.changed.notify_one();
        }
    }

    /// Waits until there may be something to remove.
    pub async fn changed(&self) {
        self.changed.notified().await;
    }
}
