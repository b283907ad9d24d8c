//! Tools of the black-box tests: the built programs on free ports, git repositories, clients, deadlines.
//!
//! Everything that a test starts ends with it. A failed test prints the logs of the programs that it started.

#![allow(
    dead_code,
    unused_imports,
    unused_macros,
    reason = "each test crate uses its own part of this"
)]

/// Skips a test, or a part of it that then returns `nothing`, and says so if a program is missing. Fails if CI is set:
/// CI tests everything.
macro_rules! needs {
    ($program:literal $(, $nothing:expr)?) => {
        if !$crate::support::is_there($program) {
            return $($nothing)?;
        }
    };
}

pub mod authority;
pub mod client;
pub mod clock;
pub mod disk;
pub mod display;
pub mod git;
pub mod http;
pub mod listener;
pub mod name_server;
pub mod network;
pub mod page;
pub mod ports;
pub mod program;
pub mod ready_class;
pub mod receiver;
pub mod relay;
pub mod reserving;
pub mod sentences;
pub mod smtp;
pub mod stand_in;
pub mod stopwatch;
pub mod webots;
pub mod wrapper;

pub use client::{Client, is_told, outcome};
pub use git::{Forge, WORLD, arm, arm_at, world};
pub use program::{Builder, Server, demo_server, server_of, server_that_is, session_server, simulation_server};
pub use webots::{DEMO, Webots, instance_folders_in, instances_below};

use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Timeout for what should happen soon. Far more than necessary, because the machine may be busy.
pub const SOON: Duration = Duration::from_mins(1);

/// Whether a program that a test needs is installed, see `needs`.
pub fn is_there(program: &str) -> bool {
    let is_there = which::which(program).is_ok();
    if !is_there {
        assert!(std::env::var_os("CI").is_none(), "this test needs {program}");
        skip(&format!("there is no {program}: tests/run.sh installs it"));
    }
    is_there
}

/// A folder that other users can read.
pub fn open_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).unwrap();
    folder
}

/// Writes an executable bash script.
pub fn make_program(path: &Path, script: &str) {
    std::fs::write(path, format!("#!/usr/bin/env bash\n{script}\n")).unwrap();
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).unwrap();
}

/// A folder with a shared library of this name, built from a source file below `tests`.
pub fn shared_library(source: &str, name: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(source);
    let mut compiler = Command::new("cc");
    let made = compiler
        .args(["-shared", "-fPIC", "-O1", "-o"])
        .arg(folder.path().join(name))
        .arg(source)
        .status();
    assert!(made.unwrap().success());
    folder
}

/// A folder with links to these programs only, for PATH.
pub fn programs(names: &[&str]) -> tempfile::TempDir {
    let folder = open_folder();
    let paths = std::env::var_os("PATH").unwrap();
    for name in names {
        let real = std::env::split_paths(&paths)
            .map(|folder| folder.join(name))
            .find(|path| path.is_file());
        let real = real.unwrap_or_else(|| panic!("this test needs {name}"));
        std::os::unix::fs::symlink(real, folder.path().join(name)).unwrap();
    }
    folder
}

/// Reports that a test or a part of it is skipped, and why. `eprintln!` would be shown only if the test fails.
pub fn skip(why: &str) {
    let test = std::thread::current().name().unwrap_or_default().to_owned();
    std::io::stderr()
        .write_all(format!("SKIPPED, for {why}: {test}\n").as_bytes())
        .unwrap();
}

/// Whether a condition becomes true within [`SOON`].
pub async fn holds_soon(mut condition: impl AsyncFnMut() -> bool) -> bool {
    let begin = Instant::now();
    while !condition().await {
        if begin.elapsed() > SOON {
            return false;
        }
        // Checks become rarer during a long wait, because each costs a busy machine time.
        let pause = (begin.elapsed() / 10).clamp(Duration::from_millis(10), Duration::from_millis(100));
        actix_rt::time::sleep(pause).await;
    }
    true
}

/// Waits until a condition holds; fails with this description if it never does.
pub async fn until(what: &str, condition: impl AsyncFnMut() -> bool) {
    assert!(holds_soon(condition).await, "waited in vain until {what}");
}

/// Raises the limit of open files of this process, and of all that it starts, to the highest allowed.
pub fn raise_file_limit() {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
}
