//! Stand-ins for Webots: the demo simulator behind a launcher, as the real one is, and scripts that misbehave.

use std::path::{Path, PathBuf};

/// The demo simulator, quoted for the shell.
pub const DEMO: &str = concat!("'", env!("CARGO_BIN_EXE_demo-simulator"), "'");

/// A folder with an executable script called `webots`.
pub struct Webots {
    folder: tempfile::TempDir,
}

impl Webots {
    /// A script with this text after `#!/usr/bin/env bash`.
    pub fn script(text: &str) -> Self {
        let folder = super::open_folder();
        super::make_program(&folder.path().join("webots"), text);
        Self { folder }
    }

    /// A launcher like that of the real Webots: it starts the simulator as its child, forwards SIGTERM, and waits.
    pub fn launcher() -> Self {
        Self::script(&format!(
            "trap 'kill -TERM $child' TERM INT\n{DEMO} \"$@\" &\nchild=$!\nwait $child\ncode=$?\ntrap - TERM INT\nwait $child 2>/dev/null\nexit $code"
        ))
    }

    /// A Webots whose simulation reaches a state, as servers call it, and stays there. In `stopping` it ignores SIGTERM
    /// and has a child in another session.
    pub fn that_is(state: &str) -> Self {
        let demo = format!("export DEMO_SIMULATOR_BIND=127.0.0.1; {DEMO} \"$@\" &");
        Self::script(&match state {
            "launching" => "sleep 1000 & sleep 1000".to_owned(),
            "running" => format!("{demo} echo real-time; wait"),
            "stopping" => format!("trap '' TERM\n(setsid sleep 1000) &\n{demo}\nwhile true; do wait; sleep 0.1; done"),
            _ => format!("{demo} wait"),
        })
    }

    pub fn path(&self) -> PathBuf {
        self.folder.path().join("webots")
    }
}

/// The processes marked as part of a simulation of a server whose cache is in this folder: pid and command line.
pub fn instances_below(folder: &Path) -> Vec<(i32, String)> {
    let folder = folder.canonicalize().unwrap();
    let mark = std::ffi::OsStr::new("WEBOTS_FLEET_INSTANCE");
    let processes = procfs::process::all_processes().unwrap().flatten();
    processes
        .filter(|process| {
            let environment = process.environ().unwrap_or_default();
            environment
                .get(mark)
                .is_some_and(|value| Path::new(value).starts_with(&folder))
        })
        .map(|process| (process.pid(), process.cmdline().unwrap_or_default().join(" ")))
        .collect()
}

/// The instance directories in a cache.
pub fn instance_folders_in(cache: &Path) -> Vec<PathBuf> {
    let inside = |folder: PathBuf| {
        std::fs::read_dir(folder)
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path())
    };
    let runs = inside(cache.join("runs"));
    let is_instance = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with("instance-");
    runs.flat_map(inside).filter(is_instance).collect()
}
