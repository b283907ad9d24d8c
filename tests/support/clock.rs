//! A time of day that a test sets.

use std::fs::File;
use std::os::unix::fs::FileExt;

use super::{Builder, shared_library};

/// A time of day that can be set, for the programs that are started with it.
pub struct Clock {
    folder: tempfile::TempDir,
    step: File,
}

impl Clock {
    /// A clock without an offset.
    pub fn new() -> Self {
        let folder = shared_library("faults/clock.c", "clock.so");
        let step = File::create(folder.path().join("step")).unwrap();
        let clock = Self { folder, step };
        clock.set(0);
        clock
    }

    /// Makes a server use this clock.
    pub fn of(&self, server: Builder) -> Builder {
        let file = |name: &str| self.folder.path().join(name).to_str().unwrap().to_owned();
        server
            .env("LD_PRELOAD", &file("clock.so"))
            .env("CLOCK_STEP", &file("step"))
    }

    /// Sets the offset from the machine's clock.
    pub fn set(&self, seconds: i64) {
        self.step.write_all_at(&seconds.to_ne_bytes(), 0).unwrap();
    }
}
