//! Listening on a port, and serving an app on it.
//!
//! actix-web's `HttpServer` makes its connections itself, and decodes all requests of one at once. To count connections and to
//! hold them to one request at a time, this builds the same service of the public parts that `HttpServer` is made of.

use std::fmt::Debug;
use std::future::ready;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::time::Duration;

use actix_http::body::MessageBody;
use actix_http::error::DispatchError;
use actix_http::{HttpService, Request, Response};
use actix_service::{IntoServiceFactory, ServiceFactory, ServiceFactoryExt, fn_service, map_config};
use actix_web::dev::{AppConfig, Server};
use actix_web::rt::net::TcpStream;
use nix::errno::Errno;
use nix::sys::socket::{setsockopt, sockopt};
use socket2::{Domain, Protocol, Socket, Type};
use tokio_util::sync::CancellationToken;

use super::client_stream::ClientStream;
use super::connections::{ConnectionKind, ConnectionLimiter};
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

/// How a server serves its connections.
#[derive(Debug, Clone)]
pub struct HttpServerOptions {
    /// Threads that serve connections.
    pub workers: usize,
    /// How many connections a thread serves; further ones wait in the system's queue, where they need no open files.
    pub max_per_worker: usize,
    /// After how long a connection is closed to which nothing could be delivered.
    pub silence: Duration,
    /// How long connections may take to end when the server stops; whole seconds count.
    pub stop: Duration,
    /// Proxies that may have more connections than one client.
    pub trusted_proxies: TrustedProxies,
}

/// Serves an app on a port. Unlike actix-web's `HttpServer` it counts connections per address, and reads from each only as
/// fast as its client takes the answers.
///
/// # Errors
/// When the system does not let the port be used.
pub fn serve<F, I, S, B>(
    port: TcpListener,
    connections: ConnectionLimiter,
    options: HttpServerOptions,
    app: F,
) -> io::Result<Server>
where
    F: Fn() -> I + Send + Clone + 'static,
    I: IntoServiceFactory<S, Request>,
    S: ServiceFactory<Request, Config = AppConfig> + 'static,
    S::Error: Into<actix_web::Error>,
    S::InitError: Debug,
    S::Response: Into<Response<B>>,
    B: MessageBody + 'static,
{
    let HttpServerOptions { workers, max_per_worker, stop, .. } = options;
    let server = Server::build().workers(workers).max_concurrent_connections(max_per_worker);
    let server = server.disable_signals().shutdown_timeout(stop.as_secs());
    // When the server stops, connections that wait for another request end at once.
    let (stops, stopping) = (server.graceful_shutdown_signal(), CancellationToken::new());
    let told = stopping.clone();
    actix_web::rt::spawn(async move {
        stops.notified().await;
        told.cancel();
    });
    let server = server.listen("http", port, move || {
        let app = app().into_factory().map_err(|error| error.into().error_response());
        let http = HttpService::build().h1(map_config(app, |()| AppConfig::default()));
        let (connections, options, stopping) = (connections.clone(), options.clone(), stopping.clone());
        fn_service(move |tcp| ready(accept(tcp, &connections, &options, &stopping))).and_then(http)
    })?;
    Ok(server.run())
}

/// Counts a connection and sets its options. It is closed at once if its address has too many.
fn accept(
    tcp: TcpStream,
    connections: &ConnectionLimiter,
    options: &HttpServerOptions,
    stopping: &CancellationToken,
) -> Result<(ClientStream, Option<SocketAddr>), DispatchError> {
    let address = tcp.peer_addr()?;
    let peer = options.trusted_proxies.of_connection(address.ip());
    let permit = connections.admit(ConnectionKind::Tcp, peer).map_err(|error| {
        log::debug!("{address}: {error}");
        io::Error::other(error)
    })?;
    // Messages are small, and must not wait until the one before is acknowledged.
    tcp.set_nodelay(true)?;
    // RFC 5482; on Linux it counts also for a client that reads nothing (tcp(7)).
    let silence = u32::try_from(options.silence.as_millis()).unwrap_or(u32::MAX);
    if let Err(error) = setsockopt(&tcp, sockopt::TcpUserTimeout, &silence) {
        log::warn!("a connection has no time limit for its answers: {error}");
    }
    Ok((ClientStream::new(tcp, permit, stopping.clone()), Some(address)))
}
