//! The WebSocket of a stream. Once both sides have agreed on it, the bytes are copied as they are: frames, their kinds and
//! close codes are not looked at. Each direction is read only as fast as the other side takes it.

use std::cell::Cell;
use std::rc::Rc;

use actix_web::web::{Bytes, Payload};
use actix_web::{HttpRequest, HttpResponse};
use actix_web_actors::ws;
use futures_util::{StreamExt, future, stream};
use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio_util::io::ReaderStream;
use tokio_util::sync::CancellationToken;

use super::upstream::{ANSWER, Upstream};
use super::watching;

/// How much is read from Webots at once, in bytes.
const READ_AT_ONCE: usize = 16 * 1024;

/// Connects a client with the WebSocket at this URL, or answers why that can't be. Of a client that `only_watches` nothing
/// reaches Webots but how it wants to watch. `held` is dropped with the connection.
pub async fn connect(
    upstream: &Upstream,
    url: &str,
    (request, payload): (&HttpRequest, Payload),
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
    let socket = match actix_rt::time::timeout(ANSWER, upstream.client().ws(url).connect()).await {
        Ok(Ok((_, framed))) => framed.into_parts(),
        Ok(Err(_)) => return HttpResponse::BadGateway().body("Error: the simulation does not answer."),
        Err(_) => return HttpResponse::GatewayTimeout().body("Error: the simulation does not answer."),
    };
    let (from_webots, to_webots) = tokio::io::split(socket.io);
    let end = CancellationToken::new();
    // Whether Webots has said something.
    let heard = Rc::new(Cell::new(false));
    actix_rt::spawn(carry(payload, to_webots, only_watches.then(|| Rc::clone(&heard)), end.clone()));
    let first = (!socket.read_buf.is_empty()).then(|| Ok(socket.read_buf.freeze()));
    let rest = ReaderStream::with_capacity(from_webots, READ_AT_ONCE);
    let said = stream::iter(first).chain(rest).take_until(end.clone().cancelled_owned());
    // It is dropped with the answer, thus when the client's connection is gone.
    let held = (held, end.drop_guard());
    response.streaming(said.map(move |part: std::io::Result<Bytes>| {
        let _ = &held;
        heard.set(true);
        part
    }))
}

/// Carries what a client says to Webots, until one of them or the connection ends; then ends the connection.
async fn carry(
    payload: Payload,
    to_webots: impl AsyncWrite + Unpin,
    watches: Option<Rc<Cell<bool>>>,
    end: CancellationToken,
) {
    let carried = async {
        match watches {
            Some(heard) => watching::introduce(payload, to_webots, &heard).await,
            None => copy(payload, to_webots).await,
        }
    };
    let (carried, ended) = (std::pin::pin!(carried), std::pin::pin!(end.cancelled()));
    future::select(carried, ended).await;
    end.cancel();
}

async fn copy(mut payload: Payload, mut to_webots: impl AsyncWrite + Unpin) {
    while let Some(Ok(part)) = payload.next().await {
        if to_webots.write_all(&part).await.is_err() {
            return;
        }
    }
}
