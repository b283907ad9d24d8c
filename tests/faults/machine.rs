//! What a machine does to its servers: memory that runs out, in a control group, and steps of the clock.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use procfs::process::Process;

use crate::support::Builder;

/// A control group in which a server, and all that it starts from now on, may take only so much more memory.
pub struct LittleMemory {
    group: PathBuf,
    /// Where its processes were, and come back to.
    home: PathBuf,
    limit: PathBuf,
}

impl LittleMemory {
    /// Nothing where control groups can't be had.
    pub fn of(pid: i32, bytes: u64) -> Option<Self> {
        let groups = Process::new(pid).and_then(|process| process.cgroups()).ok()?.0;
        let first = groups.iter().find(|group| group.controllers.iter().any(|name| name == "memory"));
        let (root, limit, own) = match first {
            Some(group) => ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", group),
            None => ("/sys/fs/cgroup", "memory.max", groups.iter().find(|group| group.hierarchy == 0)?),
        };
        let home = Path::new(root).join(own.pathname.trim_start_matches('/'));
        let inside = std::fs::read_to_string(home.join("cgroup.procs")).ok()?;
        if !inside.lines().any(|process| process == pid.to_string()) {
            return None;
        }
        let group = Path::new(root).join(format!("webots-fleet-{pid}"));
        std::fs::create_dir(&group).ok()?;
        let this = Self { limit: group.join(limit), group, home };
        let is_limited = std::fs::write(&this.limit, bytes.to_string()).is_ok();
        (is_limited && std::fs::write(this.group.join("cgroup.procs"), pid.to_string()).is_ok()).then_some(this)
    }
}

impl Drop for LittleMemory {
    fn drop(&mut self) {
        for all in ["-1", "max"] {
            std::fs::write(&self.limit, all).ok();
        }
        // What was there may have started something meanwhile.
        let deadline = Instant::now() + Duration::from_secs(5);
        while std::fs::remove_dir(&self.group).is_err() && self.group.exists() && Instant::now() < deadline {
            let inside = std::fs::read_to_string(self.group.join("cgroup.procs")).unwrap_or_default();
            for process in inside.lines() {
                std::fs::write(self.home.join("cgroup.procs"), process).ok();
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// The time of day, for the programs that are started with it: it can be set.
pub struct Clock {
    folder: tempfile::TempDir,
    step: File,
}

impl Clock {
    /// One that is right.
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/faults/clock.c");
        let mut compiler = Command::new("cc");
        compiler.args(["-shared", "-fPIC", "-O1", "-o"]).arg(folder.path().join("clock.so")).arg(source);
        assert!(compiler.status().unwrap().success());
        let step = File::create(folder.path().join("step")).unwrap();
        let clock = Self { folder, step };
        clock.set(0);
        clock
    }

    /// Has a server use this clock.
    pub fn of(&self, server: Builder) -> Builder {
        let file = |name: &str| self.folder.path().join(name).to_str().unwrap().to_owned();
        server.env("LD_PRELOAD", &file("clock.so")).env("CLOCK_STEP", &file("step"))
    }

    /// Sets by how many seconds it differs from the machine's.
    pub fn set(&self, seconds: i64) {
        self.step.write_all_at(&seconds.to_ne_bytes(), 0).unwrap();
    }
}
