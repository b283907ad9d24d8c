//! Opens WebSockets, puts what comes in pieces together, and bounds what a peer can make this server hold.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use actix::{Actor, StreamHandler};
use actix_http::ws::Item;
use actix_web::error::PayloadError;
use actix_web::web::{Bytes, Payload};
use actix_web::{HttpRequest, HttpResponse};
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext, WsResponseBuilder};
use bytestring::ByteString;
use futures_util::Stream;

/// The largest message of a client, in bytes.
const LARGEST_MESSAGE: usize = 8 * 1024;
/// How much may have come that was not yet understood as messages. The size of a message is known to actix only once
/// it is there as a whole, and it reads on while earlier ones wait: without a bound, one peer could fill the memory.
const LARGEST_BACKLOG: usize = 128 * 1024;
/// What a frame has besides its content, at most (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// What came from a peer: bytes that were not yet handed over as messages, and a text of which more is to come.
#[derive(Debug, Default)]
pub struct Inbox {
    backlog: Backlog,
    /// The pieces of a text until now (RFC 6455, section 5.4).
    pieces: Option<Vec<u8>>,
}

type Backlog = Arc<AtomicUsize>;

/// What a peer has said.
#[derive(Debug)]
pub enum Heard {
    /// A whole text.
    Text(ByteString),
    /// It wants to know whether this server lives.
    Ping(Bytes),
    /// It lives.
    Pong(Bytes),
    /// It leaves.
    Close(Option<CloseReason>),
    /// Nothing that is whole.
    Nothing,
    /// Nothing that can be understood: the connection must be closed.
    Wrong(Wrong),
}

/// Why a connection must be closed. The words are for the peer.
#[derive(Debug, thiserror::Error)]
pub enum Wrong {
    /// It is too large.
    #[error("Wrong message: it is longer than {} KiB", LARGEST_MESSAGE / 1024)]
    TooLarge,
    /// It is no text.
    #[error("Wrong message: allowed are short texts")]
    NoText,
    /// It breaks the rules of WebSockets.
    #[error("Wrong message: {0}")]
    Broken(ProtocolError),
}

impl Wrong {
    /// The code to close with.
    #[must_use]
    pub fn code(&self) -> CloseCode {
        match self {
            Self::TooLarge => CloseCode::Size,
            Self::NoText => CloseCode::Unsupported,
            Self::Broken(_) => CloseCode::Protocol,
        }
    }
}

impl Inbox {
    /// Takes what was handed over, and makes something whole of it.
    pub fn take(&mut self, message: Result<Message, ProtocolError>) -> Heard {
        self.count(&message);
        match message {
            Ok(Message::Text(text)) => Heard::Text(text),
            Ok(Message::Ping(content)) => Heard::Ping(content),
            Ok(Message::Pong(content)) => Heard::Pong(content),
            Ok(Message::Close(reason)) => Heard::Close(reason),
            Ok(Message::Nop) => Heard::Nothing,
            Ok(Message::Binary(_) | Message::Continuation(Item::FirstBinary(_))) => Heard::Wrong(Wrong::NoText),
            Ok(Message::Continuation(Item::FirstText(piece))) => {
                self.pieces = Some(Vec::new());
                self.add(&piece, false)
            }
            Ok(Message::Continuation(Item::Continue(piece))) => self.add(&piece, false),
            Ok(Message::Continuation(Item::Last(piece))) => self.add(&piece, true),
            Err(ProtocolError::Overflow) => Heard::Wrong(Wrong::TooLarge),
            Err(_) if self.backlog.load(Ordering::Relaxed) > LARGEST_BACKLOG => Heard::Wrong(Wrong::TooLarge),
            // It has gone without a word, as every closed laptop does.
            Err(ProtocolError::Io(_)) => Heard::Close(None),
            Err(error) => Heard::Wrong(Wrong::Broken(error)),
        }
    }

    fn add(&mut self, piece: &[u8], is_last: bool) -> Heard {
        let Some(mut text) = self.pieces.take() else {
            return Heard::Wrong(Wrong::Broken(ProtocolError::ContinuationNotStarted));
        };
        text.extend_from_slice(piece);
        if text.len() > LARGEST_MESSAGE {
            return Heard::Wrong(Wrong::TooLarge);
        }
        if !is_last {
            self.pieces = Some(text);
            return Heard::Nothing;
        }
        match String::from_utf8(text) {
            Ok(text) => Heard::Text(text.into()),
            Err(_) => Heard::Wrong(Wrong::NoText),
        }
    }

    fn count(&self, message: &Result<Message, ProtocolError>) {
        let content = match message {
            Ok(Message::Text(text)) => text.len(),
            Ok(
                Message::Binary(data)
                | Message::Ping(data)
                | Message::Pong(data)
                | Message::Continuation(
                    Item::FirstText(data) | Item::FirstBinary(data) | Item::Continue(data) | Item::Last(data),
                ),
            ) => data.len(),
            Ok(Message::Close(_) | Message::Nop) => 0,
            Err(_) => return,
        };
        let took = |backlog: usize| Some(backlog.saturating_sub(content + FRAME_HEADER));
        // The closure always gives a value.
        self.backlog.fetch_update(Ordering::Relaxed, Ordering::Relaxed, took).ok();
    }
}

/// The bytes of a peer, up to the largest backlog.
struct Bounded {
    stream: Payload,
    backlog: Backlog,
}

impl Stream for Bounded {
    type Item = Result<Bytes, PayloadError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = Pin::new(&mut self.stream).poll_next(context);
        if let Poll::Ready(Some(Ok(bytes))) = &next {
            let backlog = self.backlog.fetch_add(bytes.len(), Ordering::Relaxed) + bytes.len();
            if backlog > LARGEST_BACKLOG {
                return Poll::Ready(Some(Err(PayloadError::Overflow)));
            }
        }
        next
    }
}

/// Opens a WebSocket for the actor that is made, or answers why that can't be. The actor understands what comes with
/// [`Inbox::take`].
pub fn open<A>(request: &HttpRequest, stream: Payload, actor: impl FnOnce(Inbox) -> A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    let inbox = Inbox::default();
    let stream = Bounded { stream, backlog: Arc::clone(&inbox.backlog) };
    let socket = WsResponseBuilder::new(actor(inbox), request, stream).frame_size(LARGEST_MESSAGE).start();
    socket.unwrap_or_else(|error| {
        let status = error.as_response_error().error_response().status();
        HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."))
    })
}
