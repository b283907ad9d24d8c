//! The process trees of simulations: how to find their processes, and how to kill those of a run that has ended. Linux:
//! `/proc`.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs::{File, Metadata};
use std::io::{ErrorKind, Read};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::{Pid, getpgid};
use procfs::process::{Process, all_processes};

/// The environment variable that marks every process of a simulation: its value is the instance's directory. Children
/// inherit it, so that processes are found that have left their process group and lost their parent. A process that has
/// also cleared its environment is not found.
pub const MARK: &str = "WEBOTS_FLEET_INSTANCE";

/// A process and all that descends from it at this moment.
pub fn tree(root: i32) -> Vec<i32> {
    let mut found = vec![root];
    let mut next = 0;
    while let Some(pid) = found.get(next).copied() {
        found.extend(children(pid));
        next += 1;
    }
    found
}

/// The children of a process. One that has ended has none.
pub fn children(pid: i32) -> Vec<i32> {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten();
    let children = threads.flatten().filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
    children.flat_map(|ids| ids.split_whitespace().filter_map(|id| id.parse().ok()).collect::<Vec<_>>()).collect()
}

/// Kills every process that has the mark of an instance below `folder`, and the groups that such processes lead.
/// Returns the number of marked processes.
///
/// It looks until it has found none twice in a row: a process may have forked meanwhile, and one that is just executing
/// another program has no environment for a moment. Blocks for 5 ms at least, for some seconds at most.
pub fn kill_marked(folder: &Path) -> usize {
    let mut known = HashSet::new();
    let mut found_none = false;
    for _ in 0..MOST_SCANS {
        let found = marked(folder);
        if found.is_empty() && found_none {
            break;
        }
        found_none = found.is_empty();
        for process in found {
            let pid = Pid::from_raw(process.pid());
            // The only possible error is that the process has exited, as intended.
            if getpgid(Some(pid)) == Ok(pid) {
                killpg(pid, Signal::SIGKILL).ok();
            } else {
                kill(pid, Signal::SIGKILL).ok();
            }
            known.insert(process.pid());
        }
        std::thread::sleep(BETWEEN_SCANS);
    }
    known.len()
}

/// Largest number of scans for marked processes.
const MOST_SCANS: usize = 200;
/// Pause between two scans: killed processes need a moment to exit.
const BETWEEN_SCANS: Duration = Duration::from_millis(5);
/// Limit of what is read of a process's environment, in bytes: a process can set any size.
const ENVIRONMENT: u64 = 128 * 1024;

fn marked(folder: &Path) -> Vec<Process> {
    let carries_mark = |process: &Process| mark(process.pid()).is_some_and(|mark| mark.starts_with(folder));
    all_processes().into_iter().flatten().flatten().filter(carries_mark).collect()
}

/// The mark of a process. A zombie has no environment.
fn mark(pid: i32) -> Option<PathBuf> {
    let mut environment = Vec::new();
    File::open(format!("/proc/{pid}/environ")).ok()?.take(ENVIRONMENT).read_to_end(&mut environment).ok()?;
    let mut variables = environment.split(|byte| *byte == 0);
    variables
        .find_map(|one| one.strip_prefix(MARK.as_bytes())?.strip_prefix(b"="))
        .map(|mark| OsStr::from_bytes(mark).into())
}

/// The files that a process has open and that have lost their names. `None` if it hides what it has open.
pub fn nameless_files(pid: i32) -> Option<Vec<Metadata>> {
    let descriptors = match std::fs::read_dir(format!("/proc/{pid}/fd")) {
        Ok(descriptors) => descriptors,
        Err(error) if error.kind() == ErrorKind::PermissionDenied && is_running(pid) => return None,
        // It has ended.
        Err(_) => return Some(Vec::new()),
    };
    let is_nameless = |path: &Path| {
        std::fs::read_link(path).is_ok_and(|target| target.as_os_str().as_encoded_bytes().ends_with(b" (deleted)"))
    };
    let paths = descriptors.flatten().map(|descriptor| descriptor.path()).filter(|path| is_nameless(path));
    let files = paths.filter_map(|path| path.metadata().ok());
    Some(files.filter(|about| about.is_file() && about.nlink() == 0).collect())
}

/// Whether a process has not ended. One that has, and was not waited for, shows its files to nobody.
fn is_running(pid: i32) -> bool {
    Process::new(pid).and_then(|process| process.stat()).is_ok_and(|stat| !matches!(stat.state, 'Z' | 'X'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    #[test]
    fn no_more_is_read_of_an_environment_than_is_allowed() {
        let folder = tempfile::tempdir().unwrap();
        let mark = folder.path().join("instance");
        let found = |size: usize| {
            let mut sleep = Command::new("sleep");
            // Variables are sorted by name.
            sleep.arg("100").env_clear().env("PATH", "/usr/bin:/bin").env(MARK, &mark);
            for name in ["A", "B", "C"] {
                sleep.env(name, "x".repeat(size));
            }
            let mut sleep = sleep.spawn().unwrap();
            let found = marked(folder.path()).len();
            sleep.kill().unwrap();
            sleep.wait().unwrap();
            found
        };
        assert_eq!(found(1000), 1);
        assert_eq!(found(50_000), 0, "the mark comes after 128 KiB");
    }
}
