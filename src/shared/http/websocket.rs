//! WebSockets: opening them, joining messages that come in several frames, and bounding what a client can make the
//! server hold in memory.

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
const MAX_MESSAGE: usize = 8 * 1024;
/// How many received bytes may wait to be read as messages. actix tells the size of a message only when all of it is
/// there, and goes on reading while earlier messages wait: without this bound one client could fill the memory.
const MAX_BACKLOG: usize = 128 * 1024;
/// The largest header of a WebSocket frame, in bytes (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// Reads the messages of one WebSocket, and joins those that come in several frames.
#[derive(Debug, Default)]
pub struct MessageReader {
    backlog: Backlog,
    /// The frames so far of a text whose last frame has not come yet (RFC 6455, section 5.4).
    partial: Option<Vec<u8>>,
}

/// How many bytes were received and not yet read as messages.
type Backlog = Arc<AtomicUsize>;

/// A complete message of a client.
#[derive(Debug)]
pub enum ClientMessage {
    /// A text.
    Text(ByteString),
    /// A ping, which wants a pong with the same content.
    Ping(Bytes),
    /// The answer to a ping.
    Pong(Bytes),
    /// The client closes the connection, or is gone.
    Close(Option<CloseReason>),
}

/// Why a message can't be read; the connection must be closed. The words are for the client.
#[derive(Debug, thiserror::Error)]
pub enum MessageError {
    /// The message is longer than [`MAX_MESSAGE`].
    #[error("Wrong message: it is longer than {} KiB", MAX_MESSAGE / 1024)]
    TooLarge,
    /// The client sends faster than its messages are read.
    #[error("Wrong message: more than {} KiB wait to be read", MAX_BACKLOG / 1024)]
    TooMany,
    /// The message is binary, or no UTF-8.
    #[error("Wrong message: allowed are short texts")]
    NotText,
    /// The frame breaks the rules of WebSockets.
    #[error("Wrong message: {0}")]
    Protocol(ProtocolError),
}

impl MessageError {
    /// The code to close the WebSocket with.
    pub fn code(&self) -> CloseCode {
        match self {
            Self::TooLarge => CloseCode::Size,
            Self::TooMany => CloseCode::Policy,
            Self::NotText => CloseCode::Unsupported,
            Self::Protocol(_) => CloseCode::Protocol,
        }
    }
}

impl MessageReader {
    /// Reads what actix hands over. Returns nothing while a message is incomplete.
    ///
    /// # Errors
    /// When the message is too large, is no text, breaks the rules of WebSockets, or too many wait.
    pub fn read(&mut self, message: Result<Message, ProtocolError>) -> Result<Option<ClientMessage>, MessageError> {
        self.count(&message);
        match message {
            Ok(Message::Text(text)) => Ok(Some(ClientMessage::Text(text))),
            Ok(Message::Ping(content)) => Ok(Some(ClientMessage::Ping(content))),
            Ok(Message::Pong(content)) => Ok(Some(ClientMessage::Pong(content))),
            Ok(Message::Close(reason)) => Ok(Some(ClientMessage::Close(reason))),
            Ok(Message::Nop) => Ok(None),
            Ok(Message::Binary(_) | Message::Continuation(Item::FirstBinary(_))) => Err(MessageError::NotText),
            Ok(Message::Continuation(Item::FirstText(piece))) => {
                self.partial = Some(Vec::new());
                self.join(&piece, false)
            }
            Ok(Message::Continuation(Item::Continue(piece))) => self.join(&piece, false),
            Ok(Message::Continuation(Item::Last(piece))) => self.join(&piece, true),
            Err(ProtocolError::Overflow) => Err(MessageError::TooLarge),
            Err(_) if self.backlog.load(Ordering::Relaxed) > MAX_BACKLOG => Err(MessageError::TooMany),
            // The connection broke without a close frame, as with every closed laptop.
            Err(ProtocolError::Io(_)) => Ok(Some(ClientMessage::Close(None))),
            Err(error) => Err(MessageError::Protocol(error)),
        }
    }

    /// Appends a frame to the text that is under way.
    fn join(&mut self, piece: &[u8], is_last: bool) -> Result<Option<ClientMessage>, MessageError> {
        let Some(mut text) = self.partial.take() else {
            return Err(MessageError::Protocol(ProtocolError::ContinuationNotStarted));
        };
        text.extend_from_slice(piece);
        if text.len() > MAX_MESSAGE {
            return Err(MessageError::TooLarge);
        }
        if !is_last {
            self.partial = Some(text);
            return Ok(None);
        }
        let text = String::from_utf8(text).map_err(|_| MessageError::NotText)?;
        Ok(Some(ClientMessage::Text(text.into())))
    }

    /// Takes the bytes of a message off the backlog.
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
        let rest = |backlog: usize| Some(backlog.saturating_sub(content + FRAME_HEADER));
        // It can't fail: the closure always returns a value.
        self.backlog.fetch_update(Ordering::Relaxed, Ordering::Relaxed, rest).ok();
    }
}

/// The bytes that a client sends; ends with an error once the backlog is too large.
struct BoundedPayload {
    payload: Payload,
    backlog: Backlog,
}

impl Stream for BoundedPayload {
    type Item = Result<Bytes, PayloadError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = Pin::new(&mut self.payload).poll_next(context);
        if let Poll::Ready(Some(Ok(bytes))) = &next {
            let backlog = self.backlog.fetch_add(bytes.len(), Ordering::Relaxed) + bytes.len();
            if backlog > MAX_BACKLOG {
                return Poll::Ready(Some(Err(PayloadError::Overflow)));
            }
        }
        next
    }
}

/// Upgrades a request to a WebSocket that the given actor serves, or answers why that can't be. The actor must hand all
/// messages to the reader that it is given.
pub fn open<A>(request: &HttpRequest, payload: Payload, actor: impl FnOnce(MessageReader) -> A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    let reader = MessageReader::default();
    let payload = BoundedPayload { payload, backlog: Arc::clone(&reader.backlog) };
    let socket = WsResponseBuilder::new(actor(reader), request, payload).frame_size(MAX_MESSAGE).start();
    socket.unwrap_or_else(|error| {
        let status = error.as_response_error().error_response().status();
        HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."))
    })
}
