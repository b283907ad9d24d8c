//! The WebSocket of a stream: its handshake with both ends.

use actix_rt::time::timeout;
use actix_web::{HttpRequest, HttpResponse};
use actix_web_actors::ws;

use super::stream::Stream;
use super::upstream::{ANSWER_TIMEOUT, Upstream};
use crate::shared::http::{upgrade, websocket};

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
        Err(error) => return websocket::refuse(&error),
    };
    let (webots, from_webots) = match timeout(ANSWER_TIMEOUT, upstream.open_websocket(url)).await {
        Ok(Ok(opened)) => opened,
        Ok(Err(_)) => return HttpResponse::BadGateway().body("Error: the simulation does not answer."),
        Err(_) => return HttpResponse::GatewayTimeout().body("Error: the simulation does not answer."),
    };
    let upgraded = upgrade(request);
    let stream_thread = upstream.stream_thread.clone();
    actix_rt::spawn(async move {
        // An error: the client has left before the answer.
        let Ok(client) = upgraded.await else { return };
        let (Ok(to_client), Ok(to_webots)) = (client.tcp.into_std(), webots.into_std()) else { return };
        let client_end = (to_client, client.read_buffer);
        let stream = Stream::new(client_end, (to_webots, from_webots), read_only, Box::new((held, client.permit)));
        // An error: what the client has sent with its request ends the stream.
        let Ok(stream) = stream else { return };
        if let Err(error) = stream_thread.add(stream) {
            log::warn!("a stream is not relayed: {error}");
        }
    });
    response.finish()
}
