//! Listens on a port, and serves an app on it.
//!
//! actix-web's `HttpServer` accepts its connections itself, and decodes all requests of a connection at once. To count
//! connections and to limit each to one request at a time, this builds the same service from the public parts of
//! `HttpServer`.

use std::fmt::Debug;
use std::future::ready;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::os::unix::net::UnixListener;
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::Duration;

use actix_http::body::MessageBody;
use actix_http::error::DispatchError;
use actix_http::{HttpService, Request, Response};
use actix_service::{IntoServiceFactory, ServiceFactory, ServiceFactoryExt, fn_service, map_config};
use actix_web::dev::{AppConfig, Server};
use actix_web::rt::net::{TcpStream, UnixStream};
use actix_web::rt::task::JoinError;
use actix_web::rt::time::timeout;
use socket2::{Domain, SockRef, Socket, TcpKeepalive, Type};

use super::client_stream::ClientStream;
use super::limits::{ConnectionKind, ConnectionLimiter};
use super::passing::{self, Router};
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
    let socket = match Socket::new(Domain::for_address(address), Type::STREAM, None) {
        Err(_) if address.ip() == Ipv6Addr::UNSPECIFIED => {
            return listen((Ipv4Addr::UNSPECIFIED, address.port()).into());
        }
        socket => socket?,
    };
    if address.is_ipv6() {
        socket.set_only_v6(false)?;
    }
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.into())
}

/// Options of a server's connections.
#[derive(Clone)]
pub struct HttpServerOptions {
    /// Limit of connections; further ones wait in the kernel's queue, where they need no open files.
    pub max_connections: usize,
    /// Time after which a connection is closed if nothing could be delivered to it.
    pub silence: Duration,
    /// Timeout of open connections when the server stops, in whole seconds.
    pub stop: Duration,
    /// Proxies, to which the limits per address do not apply.
    pub trusted_proxies: TrustedProxies,
    /// Tells which connections are for other processes.
    pub router: Option<Arc<dyn Router>>,
}

/// Where connections come from.
pub enum Source {
    /// Clients open them.
    Port(TcpListener),
    /// Other processes of the server pass them on.
    Door(UnixListener),
}

/// Time for which another process may take to pass a connection.
const PASSING: Duration = Duration::from_secs(10);

/// Serves an app.
///
/// # Errors
/// When the system does not let the port be used.
pub fn serve<F, I, S, B>(
    source: Source,
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
    let threads = match source {
        Source::Port(_) => available_parallelism().map_or(1, usize::from),
        Source::Door(_) => 1,
    };
    let server = Server::build()
        .workers(threads)
        .max_concurrent_connections((options.max_connections / threads).max(1));
    let server = server.disable_signals().shutdown_timeout(options.stop.as_secs());
    let stops = server.graceful_shutdown_signal();
    let http = move || {
        let app = app().into_factory().map_err(|error| error.into().error_response());
        let stops = stops.clone();
        HttpService::build()
            // When the server stops, idle connections end at once.
            .graceful_shutdown_signal(move || {
                let stops = stops.clone();
                async move { stops.notified().await }
            })
            .on_connect_ext(ClientStream::on_connect)
            .h1(map_config(app, |()| AppConfig::default()))
    };
    let server = match source {
        Source::Port(port) => server.listen("http", port, move || {
            let (connections, options) = (connections.clone(), options.clone());
            fn_service(move |tcp| ready(accept(tcp, &connections, &options))).and_then(http())
        })?,
        Source::Door(door) => server.listen_uds("door", door, move || {
            let (connections, options) = (connections.clone(), options.clone());
            let accept = move |from| accept_passed(from, connections.clone(), options.clone());
            fn_service(accept).and_then(http())
        })?,
    };
    Ok(server.run())
}

/// Why a server that was not told to stop has ended, for example because the system starts no more threads.
pub fn fault(ended: Result<io::Result<()>, JoinError>) -> String {
    let why = match ended {
        Ok(Ok(())) => "nobody has stopped it".to_owned(),
        Ok(Err(error)) => error.to_string(),
        Err(panic) => panic.to_string(),
    };
    format!("the web server has ended: {why}")
}

/// Counts a connection and sets its options. An address with too many connections is refused.
fn accept(
    tcp: TcpStream,
    connections: &ConnectionLimiter,
    options: &HttpServerOptions,
) -> Result<(ClientStream, Option<SocketAddr>), DispatchError> {
    let address = tcp.peer_addr()?;
    let peer = options.trusted_proxies.of_connection(address.ip());
    let permit = connections.admit(ConnectionKind::Tcp, peer).map_err(io::Error::other)?;
    // Messages are small, and must not wait for the acknowledgement of the previous one.
    tcp.set_nodelay(true)?;
    let socket = SockRef::from(&tcp);
    // RFC 5482; on Linux it also covers a client that does not read (tcp(7)).
    socket.set_tcp_user_timeout(Some(options.silence))?;
    // Probes detect a peer that has vanished while nothing is sent, as on the stream of a paused simulation.
    let seconds = options.silence.as_secs().clamp(1, 3600);
    let probes = TcpKeepalive::new().with_time(Duration::from_secs(seconds));
    socket.set_tcp_keepalive(&probes.with_interval(Duration::from_secs(seconds.div_ceil(3))))?;
    Ok((ClientStream::new(tcp, permit, options.router.clone()), Some(address)))
}

/// Accepts a connection from another process.
async fn accept_passed(
    from: UnixStream,
    connections: ConnectionLimiter,
    options: HttpServerOptions,
) -> Result<(ClientStream, Option<SocketAddr>), DispatchError> {
    let taken = timeout(PASSING, passing::take(from)).await;
    let (tcp, progress) = taken.map_err(io::Error::other)??;
    let (stream, address) = accept(tcp, &connections, &options)?;
    Ok((stream.going_on(progress), address))
}
