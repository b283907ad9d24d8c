//! What the black-box tests stand on: the built programs on free ports, git repositories, clients, deadlines.
//!
//! Everything that a test starts ends with it, and a test that fails prints the logs of what it had started.

#![allow(dead_code, unused_imports, unused_macros, reason = "each test crate uses its own part of this")]

/// Leaves a test, or a part that then has nothing, where a program is missing that it needs, and says so. Where CI is set it fails: everything is tested there.
macro_rules! needs {
    ($program:literal $(, $nothing:expr)?) => {
        if !$crate::support::is_there($program) {
            return $($nothing)?;
        }
    };
}

pub mod authority;
pub mod client;
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
pub mod receiver;
pub mod relay;
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

/// How long anything may take that should happen soon. Far more than it needs: the machine may be busy.
pub const SOON: Duration = Duration::from_secs(20);

/// Whether a program is there that a test needs, see `needs`.
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

/// Makes a program of a script for bash.
pub fn make_program(path: &Path, script: &str) {
    std::fs::write(path, format!("#!/usr/bin/env bash\n{script}\n")).unwrap();
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).unwrap();
}

/// A folder with a shared library of this name, made of a file below `tests`.
pub fn shared_library(source: &str, name: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(source);
    let mut compiler = Command::new("cc");
    let made = compiler.args(["-shared", "-fPIC", "-O1", "-o"]).arg(folder.path().join(name)).arg(source).status();
    assert!(made.unwrap().success());
    folder
}

/// A folder with links to these programs alone, for PATH.
pub fn programs(names: &[&str]) -> tempfile::TempDir {
    let (folder, paths) = (open_folder(), std::env::var_os("PATH").unwrap());
    for name in names {
        let real = std::env::split_paths(&paths).map(|folder| folder.join(name)).find(|path| path.is_file());
        let real = real.unwrap_or_else(|| panic!("this test needs {name}"));
        std::os::unix::fs::symlink(real, folder.path().join(name)).unwrap();
    }
    folder
}

/// Says that a test, or a part of it, is left out here, and why. Not by a macro: what those print is shown for tests that fail
/// only.
pub fn skip(why: &str) {
    let test = std::thread::current().name().unwrap_or_default().to_owned();
    std::io::stderr().write_all(format!("SKIPPED, for {why}: {test}\n").as_bytes()).unwrap();
}

/// Whether a condition comes to hold before long.
pub async fn holds_soon(mut condition: impl AsyncFnMut() -> bool) -> bool {
    let begin = Instant::now();
    while !condition().await {
        if begin.elapsed() > SOON {
            return false;
        }
        // What is waited for long is asked for less often: each question costs a busy machine time.
        let pause = (begin.elapsed() / 10).clamp(Duration::from_millis(10), Duration::from_millis(100));
        actix_rt::time::sleep(pause).await;
    }
    true
}

/// Waits until a condition holds, and says what was waited for when it never does.
pub async fn until(what: &str, condition: impl AsyncFnMut() -> bool) {
    assert!(holds_soon(condition).await, "waited in vain until {what}");
}

/// Lets this process, and all that it starts, open as many files as the system allows.
pub fn raise_file_limit() {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
}
