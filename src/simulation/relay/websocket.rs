//! The WebSocket of a stream. Once both ends have agreed on it, the bytes are copied as they are: frames, their kinds and
//! close codes are not parsed. Each direction is read only as fast as the other end takes it.

use std::cell::Cell;
use std::io;
use std::net::TcpStream as StdStream;
use std::pin::pin;
use std::time::Duration;

use actix_rt::net::TcpStream;
use actix_rt::time::timeout;
use actix_web::web::Bytes;
use actix_web::{HttpRequest, HttpResponse, ResponseError};
use actix_web_actors::ws;
use futures_util::future::{self, Either};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

use super::upstream::{ANSWER_TIMEOUT, Upstream};
use super::view_requests;
use crate::shared::http::upgrade;

/// Size of the buffer for what Webots sends, scenes and pictures, in bytes.
const WEBOTS_BUFFER: usize = 16 * 1024;
/// Size of the buffer for what a client sends, in bytes.
const CLIENT_BUFFER: usize = 4 * 1024;
/// Timeout of the other direction once one has ended.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Connects a client with the WebSocket at this URL, or answers why that can't be. A client that is `read_only` can only
/// request a kind of stream. `held` is dropped with the connection.
pub async fn connect(
    upstream: &Upstream,
    url: &str,
    request: &HttpRequest,
    read_only: bool,
    held: impl Send + 'static,
) -> HttpResponse {
    let mut response = match ws::handshake(request) {
        Ok(response) => response,
        Err(error) => {
            let status = error.error_response().status();
            return HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."));
        }
    };
    let (webots, from_webots) = match timeout(ANSWER_TIMEOUT, upstream.open_websocket(url)).await {
        Ok(Ok(opened)) => opened,
        Ok(Err(_)) => return HttpResponse::BadGateway().body("Error: the simulation does not answer."),
        Err(_) => return HttpResponse::GatewayTimeout().body("Error: the simulation does not answer."),
    };
    let upgraded = upgrade::on(request);
    let stream_thread = upstream.stream_thread().clone();
    actix_rt::spawn(async move {
        // An error: the client has left before the answer.
        let Ok(client) = upgraded.await else { return };
        let (Ok(to_client), Ok(to_webots)) = (client.tcp.into_std(), webots.into_std()) else { return };
        let held = (held, client.permit);
        stream_thread.spawn_fn(move || {
            let ends = [(to_client, client.read_buffer.into()), (to_webots, from_webots)];
            actix_rt::spawn(async move {
                if let Err(error) = relay(ends, read_only).await {
                    log::debug!("a stream is not relayed: {error}");
                }
                drop(held);
            });
        });
    });
    response.finish()
}

/// Copies both directions until both have ended, or one has and the other takes too long. The ends are the client's and
/// that of Webots, with what was read of them already.
async fn relay(ends: [(StdStream, Bytes); 2], read_only: bool) -> io::Result<()> {
    let [(client, sent_by_client), (webots, sent_by_webots)] = ends;
    let (mut client, mut webots) = (TcpStream::from_std(client)?, TcpStream::from_std(webots)?);
    let ((from_client, mut to_client), (from_webots, mut to_webots)) = (client.split(), webots.split());
    let mut from_client = sent_by_client.as_ref().chain(from_client);
    let mut from_webots = sent_by_webots.as_ref().chain(from_webots);
    // Whether Webots has sent something.
    let has_answered = Cell::new(false);
    let up = async {
        if read_only {
            view_requests::forward(from_client, &mut to_webots, &has_answered).await;
        } else {
            copy(&mut from_client, &mut to_webots, CLIENT_BUFFER, || {}).await;
        }
        to_webots.shutdown().await.ok();
    };
    let down = async {
        copy(&mut from_webots, &mut to_client, WEBOTS_BUFFER, || has_answered.set(true)).await;
        to_client.shutdown().await.ok();
    };
    match future::select(pin!(up), pin!(down)).await {
        Either::Left(((), down)) => timeout(CLOSE_TIMEOUT, down).await.ok(),
        Either::Right(((), up)) => timeout(CLOSE_TIMEOUT, up).await.ok(),
    };
    Ok(())
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
