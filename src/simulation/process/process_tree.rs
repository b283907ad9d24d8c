//! The process trees of simulations: how to find their processes, and how to kill those of a run that has ended. Linux:
//! `/proc`.

use std::ffi::OsStr;
use std::fs::Metadata;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::{Pid, getpgid};
use procfs::FromReadSI;
use procfs::net::{TcpNetEntries, TcpNetEntry, TcpState};
use procfs::process::{Process, all_processes};

/// The environment variable that marks every process of a simulation: its value is the instance's directory. Children
/// inherit it, so that processes are found even if they have left their group and lost their parent. A process that has
/// also cleared its environment is not found.
pub const MARK: &str = "WEBOTS_FLEET_INSTANCE";

/// A process and its current descendants.
pub fn tree(root: i32) -> Vec<i32> {
    let mut found = vec![root];
    let mut next = 0;
    while let Some(pid) = found.get(next).copied() {
        found.extend(children(pid));
        next += 1;
    }
    found
}

/// The children of a process; none if it has ended.
pub fn children(pid: i32) -> Vec<i32> {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten();
    let children = threads
        .flatten()
        .filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
    children
        .flat_map(|ids| {
            ids.split_whitespace()
                .filter_map(|id| id.parse().ok())
                .collect::<Vec<_>>()
        })
        .collect()
}

/// Whether something listens on this port in a network of the children of a process. A child that is still in the
/// machine's network does not count: pasta listens there. Linux goes through a table of all networks for this, which
/// takes milliseconds; see [`sockets_of_children`].
pub fn children_listen(pid: i32, port: u16) -> bool {
    children_in_networks(pid).into_iter().any(|child| {
        let Ok(child) = Process::new(child) else { return false };
        let sockets = child.tcp().into_iter().chain(child.tcp6()).flatten();
        has_socket(sockets, port, &TcpState::Listen)
    })
}

/// The number of TCP sockets in networks of the children of a process, which costs little.
pub fn sockets_of_children(pid: i32) -> u64 {
    let counts = children_in_networks(pid).into_iter().flat_map(|child| {
        ["sockstat", "sockstat6"].map(|file| {
            let text = std::fs::read_to_string(format!("/proc/{child}/net/{file}")).unwrap_or_default();
            let count = text.lines().find_map(|line| {
                let (_, count) = line.strip_prefix("TCP")?.split_once(": inuse ")?;
                count.split(' ').next()?.parse().ok()
            });
            count.unwrap_or(0)
        })
    });
    counts.sum()
}

/// The children of a process that are not in the machine's network.
fn children_in_networks(pid: i32) -> Vec<i32> {
    let network = |pid: &str| std::fs::read_link(format!("/proc/{pid}/ns/net")).ok();
    let own = network("self");
    let mut children = children(pid);
    children.retain(|child| network(&child.to_string()).is_some_and(|network| Some(network) != own));
    children
}

/// Whether a connection to this port of the machine is open; `None` if that can't be read.
pub fn has_connection(port: u16) -> Option<bool> {
    let sockets = procfs::net::tcp().ok()?;
    // A machine may be without IPv6.
    let six = procfs::net::tcp6().into_iter().flatten();
    Some(has_socket(sockets.into_iter().chain(six), port, &TcpState::Established))
}

/// The same by the text of `/proc/net/tcp` and `/proc/net/tcp6`.
pub fn is_connected(tables: &str, port: u16) -> Option<bool> {
    let is_head = |line: &&str| line.trim_start().starts_with("sl");
    let (heads, rows): (Vec<&str>, Vec<&str>) = tables.lines().partition(is_head);
    let one = format!("{}\n{}", heads.first()?, rows.join("\n"));
    let TcpNetEntries(sockets) = TcpNetEntries::from_read(one.as_bytes(), procfs::current_system_info()).ok()?;
    Some(has_socket(sockets, port, &TcpState::Established))
}

/// Whether one of these sockets has this local port and state.
fn has_socket(sockets: impl IntoIterator<Item = TcpNetEntry>, port: u16, state: &TcpState) -> bool {
    let mut ports = sockets
        .into_iter()
        .filter(|socket| socket.state == *state)
        .map(|socket| socket.local_address.port());
    ports.any(|local| local == port)
}

/// Kills every process that has the mark of an instance below `folder`, and the groups that such processes lead.
///
/// It scans until it has found none twice in a row: a process may have forked meanwhile, and one that is just executing
/// another program has no environment for a moment. Blocks for 5 ms at least, for some seconds at most.
pub fn kill_marked(folder: &Path) {
    let mut found_none = false;
    for _ in 0..MOST_SCANS {
        let found = marked(folder);
        if found.is_empty() && found_none {
            break;
        }
        found_none = found.is_empty();
        for pid in found {
            // The only possible error is that the process has exited, as intended.
            if getpgid(Some(pid)) == Ok(pid) {
                killpg(pid, Signal::SIGKILL).ok();
            } else {
                kill(pid, Signal::SIGKILL).ok();
            }
        }
        std::thread::sleep(BETWEEN_SCANS);
    }
}

/// Largest number of scans for marked processes.
const MOST_SCANS: usize = 200;
/// Pause between two scans: killed processes need a moment to exit.
const BETWEEN_SCANS: Duration = Duration::from_millis(5);

/// The processes with the mark of an instance below `folder`. Zombies have no environment.
fn marked(folder: &Path) -> Vec<Pid> {
    let mark = |process: &Process| process.environ().ok()?.remove(OsStr::new(MARK));
    let is_marked = |process: &Process| mark(process).is_some_and(|mark| Path::new(&mark).starts_with(folder));
    let marked = all_processes().into_iter().flatten().flatten().filter(is_marked);
    marked.map(|process| Pid::from_raw(process.pid())).collect()
}

/// The unlinked files that a process has open. `None` if it hides its open files.
pub fn nameless_files(pid: i32) -> Option<Vec<Metadata>> {
    let descriptors = match std::fs::read_dir(format!("/proc/{pid}/fd")) {
        Ok(descriptors) => descriptors,
        Err(error) if error.kind() == ErrorKind::PermissionDenied && is_running(pid) => return None,
        // The process has ended.
        Err(_) => return Some(Vec::new()),
    };
    let is_nameless = |path: &Path| {
        std::fs::read_link(path).is_ok_and(|target| target.as_os_str().as_encoded_bytes().ends_with(b" (deleted)"))
    };
    let paths = descriptors
        .flatten()
        .map(|descriptor| descriptor.path())
        .filter(|path| is_nameless(path));
    let files = paths.filter_map(|path| path.metadata().ok());
    Some(files.filter(|about| about.is_file() && about.nlink() == 0).collect())
}

/// Whether a process has not ended. The open files of a zombie can't be read.
fn is_running(pid: i32) -> bool {
    Process::new(pid)
        .and_then(|process| process.stat())
        .is_ok_and(|stat| !matches!(stat.state, 'Z' | 'X'))
}
