//! Listens on a port, and serves an app on it.
//!
//! actix-web's `HttpServer` accepts its connections itself, and decodes all requests of a connection at once. To count
//! connections and to limit each to one request at a time, this builds the same service from the public parts of
//! `HttpServer`.

use std::fmt::Debug;
use std::future::ready;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::thread::available_parallelism;
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

/// Backlog of connections to be accepted. The kernel's own limit applies if it is smaller.
///
/// With the standard library's 128, connections of a larger burst would be dropped, and retried a second later.
const BACKLOG: i32 = i32::MAX;

/// Listens on an address. `::` is all addresses, of IPv6 and IPv4; of IPv4 alone if the machine has no IPv6.
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

/// Options of a server's connections.
#[derive(Debug, Clone)]
pub struct HttpServerOptions {
    /// Limit of connections; further ones wait in the kernel's queue, where they need no open files.
    pub max_connections: usize,
    /// Time after which a connection is closed if nothing could be delivered to it.
    pub silence: Duration,
    /// Timeout of open connections when the server stops, in whole seconds.
    pub stop: Duration,
    /// Proxies, to which the limits per address do not apply.
    pub trusted_proxies: TrustedProxies,
}

/// Serves an app on a port. Unlike actix-web's `HttpServer` it counts connections per address, and reads from each only
/// as fast as its client reads the answers.
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
    let threads = available_parallelism().map_or(1, usize::from);
    let server =
        Server::build().workers(threads).max_concurrent_connections((options.max_connections / threads).max(1));
    let server = server.disable_signals().shutdown_timeout(options.stop.as_secs());
    // When the server stops, idle connections end at once.
    let (stops, stopping) = (server.graceful_shutdown_signal(), CancellationToken::new());
    let told = stopping.clone();
    actix_web::rt::spawn(async move {
        stops.notified().await;
        told.cancel();
    });
    let server = server.listen("http", port, move || {
        let app = app().into_factory().map_err(|error| error.into().error_response());
        let http = HttpService::build()
            .on_connect_ext(ClientStream::on_connect)
            .h1(map_config(app, |()| AppConfig::default()));
        let (connections, options, stopping) = (connections.clone(), options.clone(), stopping.clone());
        fn_service(move |tcp| ready(accept(tcp, &connections, &options, &stopping))).and_then(http)
    })?;
    Ok(server.run())
}

/// Counts a connection and sets its options. An address with too many connections is refused.
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
    // Messages are small, and must not wait for the acknowledgement of the one before.
    tcp.set_nodelay(true)?;
    // RFC 5482; on Linux it also covers a client that does not read (tcp(7)).
    let silence = u32::try_from(options.silence.as_millis()).unwrap_or(u32::MAX);
    // A peer that has vanished while nothing is sent, as on the stream of a paused simulation, is noticed by probes.
    let seconds = u32::try_from(options.silence.as_secs()).unwrap_or(u32::MAX).clamp(1, 3600);
    let limited = setsockopt(&tcp, sockopt::TcpUserTimeout, &silence)
        .and_then(|()| setsockopt(&tcp, sockopt::KeepAlive, &true))
        .and_then(|()| setsockopt(&tcp, sockopt::TcpKeepIdle, &seconds))
        .and_then(|()| setsockopt(&tcp, sockopt::TcpKeepInterval, &seconds.div_ceil(3)));
    if let Err(error) = limited {
        log::warn!("a connection has no time limit for its answers: {error}");
    }
    Ok((ClientStream::new(tcp, permit, stopping.clone()), Some(address)))
}
