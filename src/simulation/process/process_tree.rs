//! Who descends from a process, which ports its tree listens on, and how a whole tree is ended. Linux: `/proc`.

use std::collections::HashSet;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use procfs::net::TcpState;
use procfs::process::{FDTarget, Process, all_processes};

/// The environment variable by which every process of an instance is known: its value is the instance's folder.
/// Children inherit it, so that even those are found that left their process group and lost their parent.
pub const MARK: &str = "WEBOTS_FLEET_INSTANCE";

/// All descendants of a process that exist at this moment, without itself.
#[must_use]
pub fn descendants(root: i32) -> Vec<i32> {
    let mut found = Vec::new();
    let mut open = vec![root];
    while let Some(pid) = open.pop() {
        for child in children(pid) {
            found.push(child);
            open.push(child);
        }
    }
    found
}

/// The children of a process, those that were not buried yet among them. One that has ended has none; that is no
/// fault.
#[must_use]
pub fn children(pid: i32) -> Vec<i32> {
    let Ok(tasks) = Process::new(pid).and_then(|process| process.tasks()) else {
        return Vec::new();
    };
    let of_task = |task: procfs::process::Task| task.children().unwrap_or_default();
    tasks.flatten().flat_map(of_task).filter_map(|child| i32::try_from(child).ok()).collect()
}

/// Ends all descendants of a process, and gives back which they were.
#[must_use]
pub fn kill_descendants(root: i32) -> HashSet<i32> {
    kill_below(root, HashSet::new())
}

/// Ends a process and all its descendants, and gives back which they were.
#[must_use]
pub fn kill_tree(root: i32) -> HashSet<i32> {
    signal_each([&root], Signal::SIGSTOP);
    kill_below(root, HashSet::from([root]))
}

/// They are stopped first, so that none can fork its way out, then killed.
fn kill_below(root: i32, mut known: HashSet<i32>) -> HashSet<i32> {
    loop {
        let fresh: Vec<i32> = descendants(root).into_iter().filter(|pid| known.insert(*pid)).collect();
        if fresh.is_empty() {
            break;
        }
        signal_each(&fresh, Signal::SIGSTOP);
    }
    signal_each(known.iter(), Signal::SIGKILL);
    known
}

/// Ends every process that carries the mark of an instance below `folder`, in whatever tree it is now.
///
/// It looks until none was found twice in a row: one of them may have forked meanwhile, and one that is just becoming
/// another program has no environment for a moment. Gives back how many there were.
#[must_use]
pub fn kill_marked(folder: &Path) -> usize {
    let mut known = HashSet::new();
    let mut found_none = false;
    for _ in 0..MOST_LOOKS {
        let found = marked(folder);
        if found.is_empty() && found_none {
            break;
        }
        found_none = found.is_empty();
        signal_each(&found, Signal::SIGKILL);
        known.extend(found);
        std::thread::sleep(BETWEEN_LOOKS);
    }
    known.len()
}

/// Waits until the guardians of instances below `folder` have ended, whose server is gone: each is ending its tree, and
/// knows more of it than the mark tells. One that was stopped goes on. Gives up after some seconds.
pub fn await_guardians(folder: &Path) {
    let deadline = Instant::now() + GUARDIANS;
    let is_guardian = |pid: &i32| {
        let line = Process::new(*pid).and_then(|process| process.cmdline());
        line.is_ok_and(|line| line.get(1).is_some_and(|word| word == "guard"))
    };
    loop {
        let guardians: Vec<i32> = marked(folder).into_iter().filter(|pid| is_guardian(pid)).collect();
        if guardians.is_empty() || Instant::now() >= deadline {
            return;
        }
        signal_each(&guardians, Signal::SIGCONT);
        std::thread::sleep(BETWEEN_LOOKS);
    }
}

/// How long guardians that have lost their server may take.
const GUARDIANS: Duration = Duration::from_secs(5);
/// How often marked processes are looked for.
const MOST_LOOKS: usize = 200;
/// Between two looks: killed processes need a moment to vanish.
const BETWEEN_LOOKS: Duration = Duration::from_millis(5);

/// Whether a process carries the mark of any instance.
#[must_use]
pub fn is_marked(pid: i32) -> bool {
    Process::new(pid).is_ok_and(|process| mark(&process).is_some())
}

fn mark(process: &Process) -> Option<PathBuf> {
    // A process that has ended, and is not yet buried, has no environment.
    process.environ().ok()?.remove(std::ffi::OsStr::new(MARK)).map(PathBuf::from)
}

fn marked(folder: &Path) -> Vec<i32> {
    let processes = all_processes().into_iter().flatten().flatten();
    let carries_mark = |process: &Process| mark(process).is_some_and(|mark| mark.starts_with(folder));
    processes.filter(carries_mark).map(|process| process.pid()).collect()
}

fn signal_each<'pid>(pids: impl IntoIterator<Item = &'pid i32>, signal: Signal) {
    for pid in pids {
        // The only fault is that the process has ended, which is what is wanted.
        kill(Pid::from_raw(*pid), signal).ok();
    }
}

/// The sockets that listen on ports of a range, as (port, inode).
#[must_use]
pub fn listeners(ports: &RangeInclusive<u16>) -> Vec<(u16, u64)> {
    let four = procfs::net::tcp().unwrap_or_default();
    let six = procfs::net::tcp6().unwrap_or_default();
    let listening = four.into_iter().chain(six).filter(|entry| entry.state == TcpState::Listen);
    listening.map(|entry| (entry.local_address.port(), entry.inode)).filter(|(port, _)| ports.contains(port)).collect()
}

/// The lowest port of a range on which a descendant of `root` listens; a listener of somebody else never counts.
#[must_use]
pub fn listening_port(root: i32, ports: &RangeInclusive<u16>) -> Option<u16> {
    let mut listeners = listeners(ports);
    if listeners.is_empty() {
        return None;
    }
    listeners.sort_unstable();
    let ours: HashSet<u64> = descendants(root).into_iter().flat_map(sockets).collect();
    listeners.into_iter().find(|(_, inode)| ours.contains(inode)).map(|(port, _)| port)
}

/// The inodes of a process's sockets.
fn sockets(pid: i32) -> Vec<u64> {
    let Ok(files) = Process::new(pid).and_then(|process| process.fd()) else {
        return Vec::new();
    };
    let socket = |file: procfs::process::FDInfo| match file.target {
        FDTarget::Socket(inode) => Some(inode),
        _ => None,
    };
    files.flatten().filter_map(socket).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn grandchildren_are_found_and_ended() {
        let script = "sleep 100 & sleep 100 & echo ready; wait";
        let mut shell = Command::new("sh").args(["-c", script]).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(shell.stdout.take().unwrap()), &mut line).unwrap();
        let pid = i32::try_from(shell.id()).unwrap();
        assert_eq!(descendants(pid).len(), 2);
        assert_eq!(kill_descendants(pid).len(), 2);
        assert!(shell.wait().is_ok());
        assert!(descendants(pid).is_empty());
    }

    #[test]
    fn a_listener_of_somebody_else_does_not_count() {
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let sleeper = Command::new("sleep").arg("100").spawn().unwrap();
        let sleeper = Ended(sleeper);
        assert_eq!(listeners(&(port..=port)).len(), 1);
        assert_eq!(listening_port(i32::try_from(sleeper.0.id()).unwrap(), &(port..=port)), None);
    }

    struct Ended(std::process::Child);

    impl Drop for Ended {
        fn drop(&mut self) {
            self.0.kill().ok();
            self.0.wait().ok();
        }
    }
}
