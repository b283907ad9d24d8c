//! Opens WebSockets, and bounds what a peer can make this server hold.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use actix::{Actor, StreamHandler};
use actix_web::error::PayloadError;
use actix_web::web::{Bytes, Payload};
use actix_web::{HttpRequest, HttpResponse};
use actix_web_actors::ws::{Message, ProtocolError, WebsocketContext, WsResponseBuilder};
use futures_util::Stream;

/// The largest message of a client, in bytes.
const LARGEST_MESSAGE: usize = 8 * 1024;
/// How much may have come that was not yet understood as messages. The size of a message is known to actix only once
/// it is there as a whole, and it reads on while earlier ones wait: without a bound, one peer could fill the memory.
const LARGEST_BACKLOG: usize = 128 * 1024;
/// What a frame has besides its content, at most (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// Bytes that came from a peer and were not yet handed over as messages.
#[derive(Debug, Clone, Default)]
pub struct Inflow(Arc<AtomicUsize>);

impl Inflow {
    /// Counts a message that was handed over.
    pub fn took(&self, message: &Result<Message, ProtocolError>) {
        let content = match message {
            Ok(Message::Text(text)) => text.len(),
            Ok(Message::Binary(data) | Message::Ping(data) | Message::Pong(data)) => data.len(),
            _ => 0,
        };
        let took = |backlog: usize| Some(backlog.saturating_sub(content + FRAME_HEADER));
        // The closure always gives a value.
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, took).ok();
    }
}

/// The bytes of a peer, up to the largest backlog.
struct Bounded {
    stream: Payload,
    backlog: Inflow,
}

impl Stream for Bounded {
    type Item = Result<Bytes, PayloadError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = Pin::new(&mut self.stream).poll_next(context);
        if let Poll::Ready(Some(Ok(bytes))) = &next {
            let backlog = self.backlog.0.fetch_add(bytes.len(), Ordering::Relaxed) + bytes.len();
            if backlog > LARGEST_BACKLOG {
                return Poll::Ready(Some(Err(PayloadError::Overflow)));
            }
        }
        next
    }
}

/// Opens a WebSocket for the actor that is made, or answers why that can't be. The actor counts each message with
/// [`Inflow::took`].
pub fn open<A>(request: &HttpRequest, stream: Payload, actor: impl FnOnce(Inflow) -> A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    let backlog = Inflow::default();
    let stream = Bounded { stream, backlog: backlog.clone() };
    let socket = WsResponseBuilder::new(actor(backlog), request, stream).frame_size(LARGEST_MESSAGE).start();
    socket.unwrap_or_else(|error| {
        let status = error.as_response_error().error_response().status();
        HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."))
    })
}
