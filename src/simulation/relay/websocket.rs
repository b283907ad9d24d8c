//! The WebSocket of a stream: its handshake with both ends.

use std::io::{self, ErrorKind};

use actix_http::ws::hash_key;
use actix_rt::net::TcpStream;
use actix_web::http::header;
use actix_web::web::{Bytes, BytesMut};
use actix_web::{HttpRequest, HttpResponse};
use actix_web_actors::ws;
use nix::sys::socket::{setsockopt, sockopt};
use socket2::SockRef;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::stream::{Direction, Stream};
use super::upstream::{Upstream, no_answer};
use super::watcher;
use super::world::until_world;
use crate::shared::http::{upgrade, websocket};
use crate::simulation::slots::StreamTarget;

/// Size limit of the head of a simulation's answer, in bytes.
const MAX_HEAD: usize = 8 * 1024;

/// Size of the kernel's buffers of each connection of a stream, in bytes; Linux doubles it, and has a limit of its own
/// (`net.core.wmem_max`, `rmem_max`). Without it, they grow up to several MiB for a client that does not read.
const SOCKET_BUFFER: usize = 256 * 1024;

/// Connects a client to the WebSocket at this path of a simulation, or responds why it can't. It waits as long as the
/// simulation lives: while Webots downloads or reads a world, and once it hangs it is ended. A client that is
/// `read_only` can only request a kind of stream. `held` is dropped with the connection.
pub async fn connect(
    upstream: &Upstream,
    target: StreamTarget,
    path: &str,
    request: &HttpRequest,
    held: impl Send + 'static,
) -> HttpResponse {
    let mut response = match ws::handshake(request) {
        Ok(response) => response,
        Err(error) => return websocket::refuse(&error),
    };
    let Ok((webots, from_webots)) = open(upstream, &target, path, request).await else {
        return no_answer();
    };
    let upgraded = upgrade(request);
    let stream_thread = upstream.stream_thread.clone();
    actix_rt::spawn(async move {
        // An error: the client has left before the answer.
        let Ok(client) = upgraded.await else { return };
        bound_buffers(&client.tcp);
        bound_buffers(&webots);
        let held = (held, client.permit);
        if target.read_only {
            // An error: one of them has left.
            watcher::relay((client.tcp, client.read_buffer), (webots, from_webots))
                .await
                .ok();
            return drop(held);
        }
        let (Ok(to_client), Ok(to_webots)) = (client.tcp.into_std(), webots.into_std()) else {
            return;
        };
        let up = Direction::new(to_client, client.read_buffer);
        let down = Direction::new(to_webots, from_webots);
        if let Err(error) = stream_thread.add(Stream::new(up, down, (target.ending, target.time), Box::new(held))) {
            log::warn!("a stream is not relayed: {error}");
        }
    });
    response.finish()
}

/// Bounds what the kernel keeps for a connection whose other end does not read.
fn bound_buffers(tcp: &TcpStream) {
    let socket = SockRef::from(tcp);
    let bounded = socket
        .set_send_buffer_size(SOCKET_BUFFER)
        .and_then(|()| socket.set_recv_buffer_size(SOCKET_BUFFER));
    if let Err(error) = bounded {
        log::warn!("the buffers of a stream are not bounded: {error}");
    }
}

/// Opens the WebSocket of a simulation with the key of its client's request. Returns the connection, and what was read
/// from it after the handshake.
async fn open(
    upstream: &Upstream,
    target: &StreamTarget,
    path: &str,
    request: &HttpRequest,
) -> io::Result<(TcpStream, Bytes)> {
    let key = request
        .headers()
        .get(header::SEC_WEBSOCKET_KEY)
        .and_then(|key| key.to_str().ok());
    let key = key.ok_or(ErrorKind::InvalidInput)?;
    let address = upstream.simulation(target.port);
    if target.answers_controllers {
        until_world(address).await?;
    }
    let mut tcp = TcpStream::connect(address).await?;
    // Messages are small, and must not wait until the one before is acknowledged.
    tcp.set_nodelay(true)?;
    // Delayed acknowledgements (TCP_QUICKACK off) would cost less, but Qt leaves Nagle's algorithm on for accepted
    // connections: a small message of Webots would wait up to 40 ms for the acknowledgement of the one before.
    setsockopt(
        &tcp,
        sockopt::TcpUserTimeout,
        &u32::try_from(upstream.silence.as_millis()).unwrap_or(u32::MAX),
    )?;
    let head = format!(
        "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n"
    );
    tcp.write_all(head.as_bytes()).await?;
    let mut answer = BytesMut::with_capacity(MAX_HEAD);
    let head = loop {
        if tcp.read_buf(&mut answer).await? == 0 || answer.len() > MAX_HEAD {
            return Err(ErrorKind::InvalidData.into());
        }
        if let Some(end) = answer.windows(4).position(|four| four == b"\r\n\r\n") {
            break answer.split_to(end + 4);
        }
    };
    let accept = hash_key(key.as_bytes());
    if !head.starts_with(b"HTTP/1.1 101 ") || !head.windows(accept.len()).any(|part| part == accept) {
        return Err(ErrorKind::InvalidData.into());
    }
    Ok((tcp, answer.freeze()))
}
