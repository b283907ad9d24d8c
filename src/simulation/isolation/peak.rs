//! What a simulation without a control group has taken, from the readings that are made for all of them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::simulation::ends::Taken;
use crate::simulation::machine::Usage;

/// What a simulation has taken at most, as far as ticks have seen it.
#[derive(Debug, Default)]
pub struct Peak {
    /// In bytes; 0 before the first tick.
    memory: AtomicU64,
    /// Processor time, in milliseconds.
    time: AtomicU64,
}

impl Peak {
    /// Takes in a reading.
    pub fn add(&self, usage: &Usage) {
        self.memory.fetch_max(usage.memory, Ordering::Relaxed);
        self.time.fetch_max(u64::try_from(usage.time.as_millis()).unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// What it has taken; nothing is known of one that ended before the first tick.
    #[must_use]
    pub fn taken(&self) -> Taken {
        let memory = Some(self.memory.load(Ordering::Relaxed)).filter(|memory| *memory > 0);
        Taken { memory, time: memory.map(|_| Duration::from_millis(self.time.load(Ordering::Relaxed))) }
    }
}
