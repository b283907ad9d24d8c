//! How this server itself reaches a simulation: an HTTP client, one for each worker, and WebSockets.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use actix_http::body::BodySize;
use actix_http::h1::ClientCodec;
use actix_http::ws::hash_key;
use actix_http::{ConnectionType, RequestHead, RequestHeadType};
use actix_rt::net::TcpStream;
use actix_web::http::header::{self, HeaderValue};
use actix_web::http::{StatusCode, Uri};
use actix_web::web::Bytes;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use futures_util::{SinkExt, StreamExt};
use nix::sys::socket::{setsockopt, sockopt};
use tokio_util::codec::Framed;

use super::stream_thread::StreamThread;

/// Timeout of a simulation's answer.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Reaches simulations on this machine.
#[derive(Clone)]
pub struct Upstream {
    /// Fetches what it serves.
    pub(super) client: awc::Client,
    address: IpAddr,
    /// Copies all streams.
    pub(super) stream_thread: StreamThread,
    silence: Duration,
}

impl Upstream {
    /// Reaches them at this address. Streams are copied on this thread. A simulation has `silence` to read what was sent to
    /// it: until then nobody notices that its client has left.
    pub fn new(address: IpAddr, stream_thread: StreamThread, silence: Duration) -> Self {
        let connector = awc::Connector::new().limit(0);
        // Redirects are not followed, and an answer may take as long as the simulation.
        let client = awc::Client::builder().connector(connector).disable_timeout().disable_redirects();
        Self { client: client.no_default_headers().finish(), address, stream_thread, silence }
    }

    /// The URL of a path and a query at the port of a simulation.
    pub fn url(&self, port: u16, path: &str, query: Option<&str>) -> String {
        let (mark, query) = query.map_or(("", ""), |query| ("?", query));
        format!("http://{}{path}{mark}{query}", SocketAddr::from((self.address, port)))
    }

    /// Opens the WebSocket at this URL of a simulation, as awc does, which does not give its TCP connection away. Returns
    /// the connection, and what was read of it after the handshake.
    pub async fn open_websocket(&self, url: &str) -> io::Result<(TcpStream, Bytes)> {
        let invalid = |problem: &str| io::Error::new(io::ErrorKind::InvalidData, problem.to_owned());
        let uri: Uri = url.parse().map_err(io::Error::other)?;
        let authority = uri.authority().ok_or_else(|| invalid("no address"))?.as_str().to_owned();
        let tcp = TcpStream::connect(&authority).await?;
        // Messages are small, and must not wait until the one before is acknowledged.
        tcp.set_nodelay(true)?;
        // What Webots sends is acknowledged at once, though fewer acknowledgements (TCP_QUICKACK) would cost less. Qt leaves Nagle's
        // algorithm on for what a server accepts: a small message of Webots would wait up to 40 ms for the one before.
        setsockopt(&tcp, sockopt::TcpUserTimeout, &u32::try_from(self.silence.as_millis()).unwrap_or(u32::MAX))?;
        let key = BASE64_STANDARD.encode(rand::random::<[u8; 16]>());
        let mut head = RequestHead::default();
        head.uri = uri;
        head.set_connection_type(ConnectionType::Upgrade);
        head.headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
        head.headers.insert(header::SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13"));
        for (name, value) in [(header::HOST, &authority), (header::SEC_WEBSOCKET_KEY, &key)] {
            head.headers.insert(name, HeaderValue::from_str(value).map_err(io::Error::other)?);
        }
        let mut framed = Framed::new(tcp, ClientCodec::default());
        framed.send((RequestHeadType::Owned(head), BodySize::None).into()).await?;
        let answer = framed.next().await.ok_or(io::ErrorKind::UnexpectedEof)?.map_err(io::Error::other)?;
        let accept = answer.headers.get(header::SEC_WEBSOCKET_ACCEPT).map(HeaderValue::as_bytes);
        if answer.status != StatusCode::SWITCHING_PROTOCOLS || accept != Some(&hash_key(key.as_bytes())[..]) {
            return Err(invalid("the handshake has failed"));
        }
        let parts = framed.into_parts();
        Ok((parts.io, parts.read_buf.freeze()))
    }
}
