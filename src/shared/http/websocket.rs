//! WebSockets: opens them, joins messages of several frames, and bounds the memory that a client can make the server
//! use.

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

use super::body;

/// Size limit of a client's message, in bytes.
const MAX_MESSAGE: usize = 8 * 1024;
/// Limit of received bytes that wait to be read as messages. actix reports the size of a message only when it is
/// complete, and continues reading while earlier messages wait: without this limit one client could fill the memory.
const MAX_BACKLOG: usize = 128 * 1024;
/// Largest header of a WebSocket frame, in bytes (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// Reads the messages of one WebSocket, and joins those of several frames.
#[derive(Debug, Default)]
pub struct MessageReader {
    backlog: Backlog,
    /// The frames received so far of a text whose last frame is missing (RFC 6455, section 5.4).
    partial: Option<Vec<u8>>,
}

/// Number of bytes that were received and not yet read as messages.
type Backlog = Arc<AtomicUsize>;

/// A complete message of a client.
#[derive(Debug)]
pub enum ClientMessage {
    /// A text message.
    Text(ByteString),
    /// A ping, which requires a pong with the same content.
    Ping(Bytes),
    /// The answer to a ping.
    Pong(Bytes),
    /// The client closes the connection, or has disconnected.
    Close(Option<CloseReason>),
}

/// Why a message can't be read, as text for the client; the connection must be closed.
#[derive(Debug, thiserror::Error)]
pub enum MessageError {
    /// The message is longer than [`MAX_MESSAGE`].
    #[error("Wrong message: it is longer than {} KiB", MAX_MESSAGE / 1024)]
    TooLarge,
    /// The client sends faster than its messages are read.
    #[error("Wrong message: more than {} KiB wait to be read", MAX_BACKLOG / 1024)]
    TooMany,
    /// The message is binary, or not UTF-8.
    #[error("Wrong message: allowed are short texts")]
    NotText,
    /// The frame violates the WebSocket protocol.
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
    /// Reads a message from actix. Returns `None` while a message is incomplete.
    ///
    /// # Errors
    /// When the message is too large, is not text, breaks the rules of WebSockets, or too many wait.
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
            // The connection broke without a close frame, as when a laptop is closed.
            Err(ProtocolError::Io(_)) => Ok(Some(ClientMessage::Close(None))),
            Err(error) => Err(MessageError::Protocol(error)),
        }
    }

    /// Appends a frame to the incomplete text.
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

    /// Subtracts the bytes of a message from the backlog.
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

/// The bytes from a client; ends with an error once the backlog is too large.
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

/// Upgrades a request to a WebSocket that the given actor serves, or answers with the error. The actor must pass all
/// messages to its reader.
pub fn open<A>(request: &HttpRequest, payload: Payload, actor: impl FnOnce(MessageReader) -> A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    if let Some(refusal) = body::refuse(request) {
        return refusal;
    }
    let reader = MessageReader::default();
    let payload = BoundedPayload { payload, backlog: Arc::clone(&reader.backlog) };
    let socket = WsResponseBuilder::new(actor(reader), request, payload).frame_size(MAX_MESSAGE).start();
    socket.unwrap_or_else(|error| {
        let status = error.as_response_error().error_response().status();
        HttpResponse::build(status).body(format!("Error: this is a WebSocket: {error}."))
    })
}
