//! What each TCP connection may hold up, whatever is said on it.
//!
//! Web frameworks wait for as long as a client takes to read its answer, and such a client costs a file and a page's
//! memory. So the system ends a connection on which nothing could be delivered for the time of silence, and an address
//! has only so many connections.

use std::any::Any;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::os::fd::AsRawFd;
use std::time::Duration;

use actix_web::dev::Extensions;
use actix_web::rt::net::TcpStream;
use nix::errno::Errno;
use nix::sys::socket::{Shutdown, setsockopt, shutdown, sockopt};
use socket2::{Domain, Protocol, Socket, Type};

use super::connections::Connections;
use super::peer::TrustedProxies;

/// How many connections may wait to be accepted. The system has a limit of its own, which counts where it is smaller.
///
/// Of the standard library's 128, those that come in a larger burst would be lost, and tried again a second later.
const BACKLOG: i32 = i32::MAX;

/// Listens on an address. `::` is all addresses, of IPv6 and IPv4; of IPv4 alone where the machine has no IPv6.
///
/// # Errors
/// When the address is taken, or may not be used.
pub fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let is_everywhere = address.ip() == IpAddr::V6(Ipv6Addr::UNSPECIFIED);
    let socket = match Socket::new(Domain::for_address(address), Type::STREAM, Some(Protocol::TCP)) {
        Err(error) if is_everywhere && error.raw_os_error() == Some(Errno::EAFNOSUPPORT as i32) => {
            return listen((Ipv4Addr::UNSPECIFIED, address.port()).into());
        }
        socket => socket?,
    };
    if is_everywhere {
        socket.set_only_v6(false)?;
    }
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.into())
}

/// Looks after the connections of a server.
#[derive(Debug)]
pub struct Sockets {
    connections: Connections,
    proxies: TrustedProxies,
    silence: Duration,
}

/// A browser has connections for pages besides those for `WebSockets`.
const PER_CLIENT: usize = 2;

impl Sockets {
    /// At most so many connections in all, and for each address of which so many clients may come; those of a trusted
    /// proxy are many clients' and count among all alone.
    #[must_use]
    pub fn new(most: usize, clients_per_address: usize, proxies: TrustedProxies, silence: Duration) -> Self {
        let connections = Connections::new(most, clients_per_address.saturating_mul(PER_CLIENT));
        Self { connections, proxies, silence }
    }

    /// Takes in a connection, or closes it at once if there are too many. To be called by `HttpServer::on_connect`.
    pub fn accept(&self, socket: &dyn Any, extensions: &mut Extensions) {
        let Some(stream) = socket.downcast_ref::<TcpStream>() else {
            return;
        };
        // RFC 5482; on Linux it counts for a peer that takes nothing in, too (tcp(7)).
        let patience = u32::try_from(self.silence.as_millis()).unwrap_or(u32::MAX);
        if let Err(error) = setsockopt(stream, sockopt::TcpUserTimeout, &patience) {
            log::warn!("a connection has no time limit for its answers: {error}");
        }
        let Ok(address) = stream.peer_addr() else {
            return;
        };
        match self.connections.admit(self.proxies.of_connection(address.ip())) {
            Ok(connection) => drop(extensions.insert(connection)),
            Err(crowded) => {
                log::debug!("{address}: {crowded}");
                // It may have gone by itself.
                shutdown(stream.as_raw_fd(), Shutdown::Both).ok();
            }
        }
    }
}
