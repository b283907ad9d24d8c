//! Measures how long the programs take on a machine that other tests keep busy.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Sleep of the thread that detects when this machine runs no thread of ours.
const NAP: Duration = Duration::from_millis(10);

/// Measures time without the time in which this process waited for a processor.
pub struct Stopwatch {
    /// In microseconds.
    held_up: Arc<AtomicU64>,
}

/// A running measurement.
pub struct Lap<'watch> {
    watch: &'watch Stopwatch,
    begin: Instant,
    held_up: Duration,
}

impl Stopwatch {
    /// Watches the machine until this value is dropped.
    pub fn start() -> Self {
        let held_up = Arc::new(AtomicU64::new(0));
        let shared = Arc::downgrade(&held_up);
        std::thread::spawn(move || {
            while let Some(held_up) = shared.upgrade() {
                let begin = Instant::now();
                std::thread::sleep(NAP);
                let late = begin.elapsed().saturating_sub(NAP);
                held_up.fetch_add(u64::try_from(late.as_micros()).unwrap(), Ordering::Relaxed);
            }
        });
        Self { held_up }
    }

    /// Starts a measurement.
    pub fn lap(&self) -> Lap<'_> {
        Lap {
            watch: self,
            begin: Instant::now(),
            held_up: self.held_up(),
        }
    }

    fn held_up(&self) -> Duration {
        Duration::from_micros(self.held_up.load(Ordering::Relaxed))
    }
}

impl Lap<'_> {
    /// The part of the time since the start in which this process waited for a processor.
    pub fn held_up(&self) -> Duration {
        self.watch.held_up() - self.held_up
    }

    /// The time since the start.
    pub fn wall(&self) -> Duration {
        self.begin.elapsed()
    }

    /// The time since the start, without the waits for a processor.
    pub fn elapsed(&self) -> Duration {
        self.wall().saturating_sub(self.held_up())
    }
}
