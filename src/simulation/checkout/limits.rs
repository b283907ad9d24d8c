//! What a checkout may take. Pure.

use std::time::Duration;

/// What a checkout may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// For all of it.
    pub time: Duration,
    /// In bytes: what is fetched, and what is checked out.
    pub size: u64,
    /// Whether any commit may be fetched by its hash, not only those of branches and tags.
    pub any_commit: bool,
}

/// So many bytes of the size that a project may have allow for one file or folder: it takes about that of a disk.
const ENTRY: u64 = 4096;
/// So many files and folders any project may have.
const FEW_ENTRIES: u64 = 10_000;

impl Limits {
    /// A remote that is silent for so long is asked anew: often it is but a connection that has died. Tidying up holds
    /// a fetch up for no longer either.
    #[must_use]
    pub fn patience(&self) -> Duration {
        self.time / 4
    }

    /// How many files and folders may be checked out.
    #[must_use]
    pub fn entries(&self) -> u64 {
        (self.size / ENTRY).max(FEW_ENTRIES)
    }
}
