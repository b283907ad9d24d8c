//! How many checkouts of a repository overlap: all of them write to the directory of its large files.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The checkouts of a repository, by their numbers.
#[derive(Debug, Default)]
pub struct Overlap {
    begun: AtomicU64,
    ended: AtomicU64,
}

/// A checkout that runs. Dropping it ends it.
pub struct Running<'a> {
    all: &'a Overlap,
    ended_before: u64,
}

impl Overlap {
    /// A checkout begins.
    pub fn begin(&self) -> Running<'_> {
        let ended_before = self.ended.load(Relaxed);
        self.begun.fetch_add(1, Relaxed);
        Running {
            all: self,
            ended_before,
        }
    }
}

impl Running<'_> {
    /// The number of checkouts that have run at any time since this one began, itself included.
    pub fn overlapping(&self) -> u64 {
        self.all.begun.load(Relaxed) - self.ended_before
    }
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        self.all.ended.fetch_add(1, Relaxed);
    }
}
