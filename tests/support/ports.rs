//! Blocks of free ports, and closed ports. Simulation servers need consecutive ports that are free on all addresses.

use std::fs::File;
use std::net::{Ipv4Addr, TcpListener};

use nix::fcntl::{Flock, FlockArg};
use tokio::net::TcpSocket;

/// Below the system's ports for outgoing connections, and below those that the tests of the demo simulator use.
const FIRST: u16 = 10_000;
const LAST: u16 = 21_000;

/// The first of `count` consecutive free ports. Other tests of this user get these ports only after all others.
pub fn block(count: u16) -> u16 {
    // The next port is in a file that the processes of all tests lock.
    let path = std::env::temp_dir().join(format!("webots-fleet-test-ports-{}", nix::unistd::getuid()));
    let file = File::options()
        .create(true)
        .truncate(false)
        .read(true)
        .write(true)
        .open(&path)
        .unwrap();
    let _locked = Flock::lock(file, FlockArg::LockExclusive)
        .map_err(|(_, error)| error)
        .unwrap();
    let next = std::fs::read_to_string(&path).unwrap().trim().parse().unwrap_or(FIRST);
    let free = |port| TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
    let starts = (next..LAST - count).chain(FIRST..next);
    let first = starts
        .step_by(usize::from(count))
        .find(|first| (*first..first + count).all(free));
    let first = first.unwrap_or_else(|| panic!("no {count} free ports in a row"));
    std::fs::write(&path, (first + count).to_string()).unwrap();
    first
}

/// A port on which no program listens, or can listen until the first value is dropped.
pub fn dead_port() -> (TcpSocket, u16) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(([127, 0, 0, 1], 0).into()).unwrap();
    let port = socket.local_addr().unwrap().port();
    (socket, port)
}
