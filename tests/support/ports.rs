//! Blocks of free ports, and dead ones. Simulation servers need ports in a row, and test each for being free on all addresses.

use std::net::{Ipv4Addr, TcpListener};
use std::sync::atomic::{AtomicU16, Ordering};

use tokio::net::TcpSocket;

/// Below the ports that the system gives to outgoing connections, and below those that the demo simulator is tested at.
const FIRST: u16 = 10_000;
const LAST: u16 = 21_000;

static NEXT: AtomicU16 = AtomicU16::new(0);

/// The first of `count` free ports in a row, which no other test of this process is given.
pub fn block(count: u16) -> u16 {
    // Other test processes begin elsewhere.
    let start = u16::try_from(std::process::id() % 100).unwrap() * 100;
    for _ in 0..1000 {
        let first = FIRST + start.wrapping_add(NEXT.fetch_add(count, Ordering::Relaxed)) % (LAST - FIRST);
        let free = |port| TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
        if first + count <= LAST && (first..first + count).all(free) {
            return first;
        }
    }
    panic!("no {count} free ports in a row");
}

/// A port on which nobody listens, nor can anybody until the first value is dropped.
pub fn dead_port() -> (TcpSocket, u16) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(([127, 0, 0, 1], 0).into()).unwrap();
    let port = socket.local_addr().unwrap().port();
    (socket, port)
}
