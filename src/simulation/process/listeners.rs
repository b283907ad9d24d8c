//! The listening ports of this machine, from the kernel's netlink interface (`sock_diag`, see `man 7 sock_diag`).
//!
//! Only sockets in the state LISTEN are requested, so that the kernel walks its small table of listeners. A read of
//! `/proc/net/tcp` makes it walk all connections, which took 8.7 ms on a machine without any.

use std::io;
use std::ops::RangeInclusive;

use netlink_packet_core::{NLM_F_DUMP, NLM_F_REQUEST, NetlinkHeader, NetlinkMessage, NetlinkPayload};
use netlink_packet_sock_diag::SockDiagMessage;
use netlink_packet_sock_diag::constants::{AF_INET, AF_INET6, IPPROTO_TCP};
use netlink_packet_sock_diag::inet::{ExtensionFlags, InetRequest, SocketId, StateFlags};
use netlink_sys::protocols::NETLINK_SOCK_DIAG;
use netlink_sys::{Socket, SocketAddr};

/// A TCP socket that listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Listener {
    /// Its port.
    pub port: u16,
    /// Its inode, as in the descriptors of processes (`socket:[INODE]`).
    pub inode: u64,
}

/// The sockets that listen on ports of a range, IPv4 and IPv6, sorted by port.
///
/// # Errors
/// When the system has no `sock_diag`.
pub fn listeners(ports: &RangeInclusive<u16>) -> io::Result<Vec<Listener>> {
    let socket = Socket::new(NETLINK_SOCK_DIAG)?;
    socket.connect(&SocketAddr::new(0, 0))?;
    let mut found = Vec::new();
    for (family, socket_id) in [(AF_INET, SocketId::new_v4()), (AF_INET6, SocketId::new_v6())] {
        ask(&socket, family, socket_id)?;
        while read(&socket, ports, &mut found)? {}
    }
    found.sort_unstable();
    Ok(found)
}

/// Requests all listeners of a version of IP.
fn ask(socket: &Socket, family: u8, socket_id: SocketId) -> io::Result<()> {
    let mut header = NetlinkHeader::default();
    header.flags = NLM_F_REQUEST | NLM_F_DUMP;
    let (protocol, extensions, states) = (IPPROTO_TCP, ExtensionFlags::empty(), StateFlags::LISTEN);
    let request = SockDiagMessage::InetRequest(InetRequest { family, protocol, extensions, states, socket_id });
    let mut message = NetlinkMessage::new(header, request.into());
    message.finalize();
    let mut bytes = vec![0; message.buffer_len()];
    message.serialize(&mut bytes);
    socket.send(&bytes, 0).map(drop)
}

/// Reads a part of the answer. Returns whether more is to come.
fn read(socket: &Socket, ports: &RangeInclusive<u16>, found: &mut Vec<Listener>) -> io::Result<bool> {
    let (bytes, _) = socket.recv_from_full()?;
    let mut rest = bytes.as_slice();
    while !rest.is_empty() {
        let message = NetlinkMessage::<SockDiagMessage>::deserialize(rest).map_err(io::Error::other)?;
        match message.payload {
            NetlinkPayload::Done(_) => return Ok(false),
            NetlinkPayload::Error(error) => return Err(error.into()),
            NetlinkPayload::InnerMessage(SockDiagMessage::InetResponse(one)) => {
                let (port, inode) = (one.header.socket_id.source_port, u64::from(one.header.inode));
                found.extend(ports.contains(&port).then_some(Listener { port, inode }));
            }
            _ => {}
        }
        // Messages begin at multiples of four bytes.
        let length = usize::try_from(message.header.length).unwrap_or(usize::MAX).max(1).next_multiple_of(4);
        rest = rest.get(length..).unwrap_or_default();
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr, TcpListener, TcpStream};

    use super::*;

    #[test]
    fn listeners_are_found_and_connections_are_not() {
        let four = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = four.local_addr().unwrap().port();
        let six = TcpListener::bind((Ipv6Addr::LOCALHOST, port)).ok();
        let _connection = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
        let found = listeners(&(port..=port)).unwrap();
        assert_eq!(found.len(), 1 + usize::from(six.is_some()), "{found:?}");
        assert!(found.iter().all(|one| one.port == port && one.inode > 0), "{found:?}");
        drop((four, six));
        // Another socket may use the port by now.
        let left = listeners(&(port..=port)).unwrap();
        assert!(left.iter().all(|one| !found.contains(one)), "{left:?}");
    }

    #[test]
    fn all_of_many_are_found() {
        let all: Vec<TcpListener> = (0..400).map(|_| TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap()).collect();
        let found = listeners(&(1..=u16::MAX)).unwrap();
        for one in all {
            let port = one.local_addr().unwrap().port();
            assert!(found.iter().any(|found| found.port == port), "{port}");
        }
    }
}
