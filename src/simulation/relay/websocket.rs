//! The WebSocket of a stream. Once both ends have agreed on it, the bytes are copied as they are: frames, their kinds and
//! close codes are not parsed. Each direction is read only as fast as the other end takes it.

use std::cell::Cell;
use std::pin::pin;
use std::time::Duration;

use actix_rt::time::timeout;
use actix_web::HttpRequest;
use actix_web::HttpResponse;
use actix_web::web::Bytes;
use actix_web_actors::ws;
use futures_util::future::{self, Either};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

use super::upstream::{ANSWER, Upstream};
use super::watching;
use crate::shared::http::upgrade;

/// Sizes of the buffers for what Webots sends, scenes and pictures, and for what clients send, in bytes.
const FROM_WEBOTS: usize = 16 * 1024;
const FROM_CLIENT: usize = 4 * 1024;
/// How long the other direction may go on once one has ended.
const CLOSING: Duration = Duration::from_secs(5);

/// Connects a client with the WebSocket at this URL, or answers why that can't be. Of a client that `only_watches` nothing
/// reaches Webots but how it wants to watch. `held` is dropped with the connection.
pub async fn connect(
    upstream: &Upstream,
    url: &str,
    request: &HttpRequest,
    only_watches: bool,
    held: impl std::any::Any,
) -> HttpResponse {
    let mut response = match ws::handshake(request) {
        Ok(response) => response,
        Err(error) => {
            let status = actix_web::ResponseError::error_response(&error).status();
            return HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."));
        }
    };
    let webots = match timeout(ANSWER, upstream.client().ws(url).connect()).await {
        Ok(Ok((_, framed))) => framed.into_parts(),
        Ok(Err(_)) => return HttpResponse::BadGateway().body("Error: the simulation does not answer."),
        Err(_) => return HttpResponse::GatewayTimeout().body("Error: the simulation does not answer."),
    };
    let upgraded = upgrade::on(request);
    actix_rt::spawn(async move {
        // An error: the client has left before the answer.
        if let Ok(mut client) = upgraded.await {
            let client_end = (client.tcp.split(), client.read_buffer.into());
            let webots_end = (tokio::io::split(webots.io), webots.read_buf.freeze());
            relay(client_end, webots_end, only_watches).await;
        }
        drop(held);
    });
    response.finish()
}

/// The reader and the writer of a connection, and what was read of it already.
type End<R, W> = ((R, W), Bytes);

/// Copies both directions until both have ended, or one has and the other goes on for too long.
async fn relay<R, W, S, T>(client: End<R, W>, webots: End<S, T>, only_watches: bool)
where
    R: AsyncRead + Unpin,
    W: AsyncWrite + Unpin,
    S: AsyncRead + Unpin,
    T: AsyncWrite + Unpin,
{
    let ((from_client, mut to_client), sent_by_client) = client;
    let ((mut from_webots, mut to_webots), sent_by_webots) = webots;
    // Whether Webots has sent something.
    let has_answered = Cell::new(false);
    let up = async {
        let mut from_client = sent_by_client.as_ref().chain(from_client);
        if only_watches {
            watching::introduce(from_client, &mut to_webots, &has_answered).await;
        } else {
            copy(&mut from_client, &mut to_webots, FROM_CLIENT, || {}).await;
        }
        to_webots.shutdown().await.ok();
    };
    let down = async {
        let mut from_webots = sent_by_webots.as_ref().chain(&mut from_webots);
        copy(&mut from_webots, &mut to_client, FROM_WEBOTS, || has_answered.set(true)).await;
        to_client.shutdown().await.ok();
    };
    match future::select(pin!(up), pin!(down)).await {
        Either::Left(((), down)) => timeout(CLOSING, down).await.ok(),
        Either::Right(((), up)) => timeout(CLOSING, up).await.ok(),
    };
}

/// Copies until one end closes; calls `on_read` after each read.
async fn copy(
    from: &mut (impl AsyncRead + Unpin),
    to: &mut (impl AsyncWrite + Unpin),
    size: usize,
    on_read: impl Fn(),
) {
    let mut buffer = vec![0; size];
    while let Ok(length @ 1..) = from.read(&mut buffer).await {
        on_read();
        if to.write_all(buffer.get(..length).unwrap_or_default()).await.is_err() {
            return;
        }
    }
}
