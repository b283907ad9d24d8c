//! What each TCP connection may hold up, whatever is said on it.
//!
//! Web frameworks wait for as long as a client takes to read its answer, and such a client costs a file and a page's
//! memory. So the system ends a connection on which nothing could be delivered for the time of silence, and an address
//! has only so many connections.

use std::any::Any;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::AsRawFd;
use std::time::Duration;

use actix_web::dev::Extensions;
use actix_web::rt::net::TcpStream;
use nix::sys::socket::{self, Backlog, Shutdown, setsockopt, shutdown, sockopt};

use super::connections::Connections;
use super::peer::TrustedProxies;

/// Listens on an address. As many connections as the system allows may wait to be accepted: of the standard library's
/// 128, those that come in a larger burst would be lost, and tried again a second later.
///
/// # Errors
/// When the address is taken, or may not be used.
pub fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = TcpListener::bind(address)?;
    socket::listen(&socket, Backlog::MAXALLOWABLE)?;
    Ok(socket)
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
