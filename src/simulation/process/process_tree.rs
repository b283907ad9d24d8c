//! The processes of a simulation: how they are found and ended, and which port they listen on. Linux: `/proc`.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::{Pid, getpgid};
use procfs::net::TcpState;
use procfs::process::{FDTarget, Process, all_processes};

/// The environment variable that marks every process of a simulation: its value is the instance's folder. Children
/// inherit it, so that also those are found that have left their process group and lost their parent. One that has
/// also dropped its environment is not found.
pub const MARK: &str = "WEBOTS_FLEET_INSTANCE";

/// A process and all that descends from it at this moment.
#[must_use]
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
#[must_use]
pub fn children(pid: i32) -> Vec<i32> {
    let Ok(tasks) = Process::new(pid).and_then(|process| process.tasks()) else {
        return Vec::new();
    };
    let of_task = |task: procfs::process::Task| task.children().unwrap_or_default();
    tasks.flatten().flat_map(of_task).filter_map(|child| i32::try_from(child).ok()).collect()
}

/// Kills every process that carries the mark of an instance below `folder`, and the groups that such processes lead.
/// Returns how many marked processes there were.
///
/// It looks until it has found none twice in a row: a process may have forked meanwhile, and one that is just executing
/// another program has no environment for a moment. Blocks for 5 ms at least, for some seconds at most.
#[expect(clippy::must_use_candidate, reason = "most callers want what it does, not how many there were")]
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
            // The only fault is that the process has ended, which is what is wanted.
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

/// How often marked processes are looked for at most.
const MOST_SCANS: usize = 200;
/// Time between two scans: killed processes need a moment to vanish.
const BETWEEN_SCANS: Duration = Duration::from_millis(5);
/// Time between the first two checks whether a process listens.
const FIRST_POLL: Duration = Duration::from_millis(10);
/// Time between two of these checks, at most.
const SLOWEST_POLL: Duration = Duration::from_millis(200);

fn marked(folder: &Path) -> Vec<Process> {
    let carries_mark = |process: &Process| {
        // A process that has ended, and was not yet waited for, has no environment.
        let mark = process.environ().ok().and_then(|mut environment| environment.remove(OsStr::new(MARK)));
        mark.is_some_and(|mark| Path::new(&mark).starts_with(folder))
    };
    all_processes().into_iter().flatten().flatten().filter(carries_mark).collect()
}

/// The sockets that listen on ports of a range, as (port, inode).
fn listeners(ports: &RangeInclusive<u16>) -> Vec<(u16, u64)> {
    let four = procfs::net::tcp().unwrap_or_default();
    let six = procfs::net::tcp6().unwrap_or_default();
    let listening = four.into_iter().chain(six).filter(|entry| entry.state == TcpState::Listen);
    listening.map(|entry| (entry.local_address.port(), entry.inode)).filter(|(port, _)| ports.contains(port)).collect()
}

/// The ports of a range on which `root` or a descendant of it listens, the lowest first; a listener of somebody else
/// never counts.
#[must_use]
pub fn listening_ports(root: i32, ports: &RangeInclusive<u16>) -> Vec<u16> {
    let mut listeners = listeners(ports);
    if listeners.is_empty() {
        return Vec::new();
    }
    listeners.sort_unstable();
    let own: HashSet<u64> = tree(root).into_iter().flat_map(sockets).collect();
    let mut found: Vec<u16> =
        listeners.into_iter().filter(|(_, inode)| own.contains(inode)).map(|(port, _)| port).collect();
    // A socket for each of IPv4 and IPv6 may have the same port.
    found.dedup();
    found
}

/// Waits until a descendant of `root` listens on a port of a range, and returns that port. It takes as long as that takes.
pub async fn until_listening(root: i32, ports: RangeInclusive<u16>) -> u16 {
    let mut pause = FIRST_POLL;
    loop {
        actix_rt::time::sleep(pause).await;
        let ports = ports.clone();
        let found = actix_rt::task::spawn_blocking(move || listening_ports(root, &ports)).await;
        if let Some(port) = found.ok().and_then(|ports| ports.first().copied()) {
            return port;
        }
        pause = (pause * 3 / 2).min(SLOWEST_POLL);
    }
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
    use std::os::unix::process::CommandExt;
    use std::process::{Command, Stdio};

    #[test]
    fn all_that_carries_the_mark_is_killed_with_the_groups_that_it_leads() {
        let folder = tempfile::tempdir().unwrap();
        // A grandchild in a session of its own keeps the mark; one without environment stays in the group of its parent.
        let script = "setsid sleep 100 & env -i sleep 100 & echo $!; wait";
        let mut shell = Command::new("bash");
        shell.args(["-c", script]).env(MARK, folder.path().join("instance")).process_group(0);
        let mut shell = shell.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(shell.stdout.take().unwrap()), &mut line).unwrap();
        let bare = line.trim().parse().unwrap();
        let deadline = std::time::Instant::now() + Duration::from_secs(20);
        let pid = i32::try_from(shell.id()).unwrap();
        while tree(pid).len() < 3 || marked(folder.path()).len() != 2 {
            assert!(std::time::Instant::now() < deadline, "{:?}", tree(pid));
            std::thread::sleep(BETWEEN_SCANS);
        }
        assert_eq!(kill_marked(folder.path()), 2);
        assert!(!shell.wait().unwrap().success());
        assert_eq!(marked(folder.path()).len(), 0);
        while Process::new(bare).is_ok_and(|process| process.stat().is_ok_and(|stat| stat.state != 'Z')) {
            assert!(std::time::Instant::now() < deadline, "the one without environment lives on");
            std::thread::sleep(BETWEEN_SCANS);
        }
    }

    #[test]
    fn a_listener_of_somebody_else_does_not_count() {
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let sleeper = Command::new("sleep").arg("100").spawn().unwrap();
        let sleeper = Ended(sleeper);
        assert_eq!(listeners(&(port..=port)).len(), 1);
        assert!(listening_ports(i32::try_from(sleeper.0.id()).unwrap(), &(port..=port)).is_empty());
    }

    struct Ended(std::process::Child);

    impl Drop for Ended {
        fn drop(&mut self) {
            self.0.kill().ok();
            self.0.wait().ok();
        }
    }
}
