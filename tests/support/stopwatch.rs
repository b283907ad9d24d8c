//! Times what the programs do on a machine that other tests keep busy.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How long the thread sleeps that notices when this machine lets nobody run.
const NAP: Duration = Duration::from_millis(10);

/// Time, less that in which this machine let us wait for a processor.
pub struct Stopwatch {
    /// In microseconds.
    held_up: Arc<AtomicU64>,
}

/// A time that is being taken.
pub struct Lap<'watch> {
    watch: &'watch Stopwatch,
    begin: Instant,
    held_up: Duration,
}

impl Stopwatch {
    /// Begins to watch the machine, until this value is dropped.
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

    /// Begins to take a time.
    pub fn lap(&self) -> Lap<'_> {
        Lap { watch: self, begin: Instant::now(), held_up: self.held_up() }
    }

    fn held_up(&self) -> Duration {
        Duration::from_micros(self.held_up.load(Ordering::Relaxed))
    }
}

impl Lap<'_> {
    /// How much of the time since the beginning the machine let us wait.
    pub fn held_up(&self) -> Duration {
        self.watch.held_up() - self.held_up
    }

    /// All of that time.
    pub fn wall(&self) -> Duration {
        self.begin.elapsed()
    }

    /// What is left of it without.
    pub fn elapsed(&self) -> Duration {
        self.wall().saturating_sub(self.held_up())
    }
}
