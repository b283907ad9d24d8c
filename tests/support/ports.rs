//! Blocks of free ports, and dead ones. Simulation servers need ports in a row, and test each for being free on all addresses.

use std::fs::File;
use std::io::{Read, Seek, Write};
use std::net::{Ipv4Addr, TcpListener};

use nix::fcntl::{Flock, FlockArg};
use tokio::net::TcpSocket;

/// Below the ports that the system gives to outgoing connections, and below those that the demo simulator is tested at.
const FIRST: u16 = 10_000;
const LAST: u16 = 21_000;

/// The first of `count` free ports in a row, which no other test of this user is given until all others were.
pub fn block(count: u16) -> u16 {
    let mut next = Next::lock();
    for _ in 0..1000 {
        let first = if next.0 + count > LAST { FIRST } else { next.0 };
        next.0 = first + count;
        let free = |port| TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
        if (first..first + count).all(free) {
            next.keep();
            return first;
        }
    }
    panic!("no {count} free ports in a row");
}

/// The port that is given next, in a file that the processes of all tests lock.
struct Next(u16, Flock<File>);

impl Next {
    fn lock() -> Self {
        let path = std::env::temp_dir().join(format!("webots-fleet-test-ports-{}", nix::unistd::getuid()));
        let file = File::options().create(true).truncate(false).read(true).write(true).open(path).unwrap();
        let mut file = Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, error)| error).unwrap();
        let mut text = String::new();
        file.read_to_string(&mut text).unwrap();
        let next = text.trim().parse().ok().filter(|port| (FIRST..LAST).contains(port));
        Self(next.unwrap_or(FIRST), file)
    }

    fn keep(mut self) {
        self.1.rewind().unwrap();
        writeln!(self.1, "{}", self.0).unwrap();
    }
}

/// A port on which nobody listens, nor can anybody until the first value is dropped.
pub fn dead_port() -> (TcpSocket, u16) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(([127, 0, 0, 1], 0).into()).unwrap();
    let port = socket.local_addr().unwrap().port();
    (socket, port)
}
