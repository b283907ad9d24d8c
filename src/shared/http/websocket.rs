//! WebSockets: opens them, and joins messages of several frames.

use std::cell::Cell;
use std::rc::Rc;

use actix::{Actor, AsyncContext, StreamHandler};
use actix_http::ws::{Codec, Frame, Item};
use actix_web::web::{Bytes, BytesMut, Payload};
use actix_web::{HttpRequest, HttpResponse, ResponseError};
use actix_web_actors::ws::{self, CloseCode, HandshakeError, Message, ProtocolError, WebsocketContext};
use bytestring::ByteString;
use futures_util::stream::{self, Stream, StreamExt};
use tokio_util::codec::Decoder;

use super::routing::refuse_body;
use crate::shared::domain::MAX_LINK_MESSAGE;

/// Size limit of a client's message, in bytes.
const MAX_MESSAGE: usize = 8 * 1024;
/// Largest header of a WebSocket frame, in bytes (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// Why a connection must be closed, as text for the client, with the close code: the client has sent neither a valid
/// text nor a control frame.
pub fn wrong_message(message: Result<Message, ProtocolError>) -> (String, CloseCode) {
    let (problem, code) = match message {
        Ok(_) => ("allowed are short texts".to_owned(), CloseCode::Unsupported),
        Err(ProtocolError::Overflow) => (format!("it is longer than {} KiB", MAX_MESSAGE / 1024), CloseCode::Size),
        Err(error) => (error.to_string(), CloseCode::Protocol),
    };
    (format!("Wrong message: {problem}"), code)
}

/// Size limit of the messages of a connection. Its actor raises it once it knows the peer.
#[derive(Debug, Clone)]
pub struct MessageLimit(Rc<Cell<usize>>);

impl Default for MessageLimit {
    fn default() -> Self {
        Self(Rc::new(Cell::new(MAX_MESSAGE)))
    }
}

impl MessageLimit {
    /// Allows messages of up to [`MAX_LINK_MESSAGE`] from now on.
    pub fn raise(&self) {
        self.0.set(MAX_LINK_MESSAGE);
    }
}

/// Splits the bytes of a client into frames.
pub struct FrameReader {
    codec: Codec,
    /// The bytes of an incomplete frame.
    unread: BytesMut,
    limit: MessageLimit,
}

impl Default for FrameReader {
    fn default() -> Self {
        Self::new(MessageLimit::default())
    }
}

impl FrameReader {
    fn new(limit: MessageLimit) -> Self {
        Self {
            codec: Codec::new().max_size(MAX_LINK_MESSAGE),
            unread: BytesMut::new(),
            limit,
        }
    }

    /// Size limit of a frame, in bytes.
    fn max(&self) -> usize {
        self.limit.0.get()
    }

    /// Adds bytes of the client.
    pub fn add(&mut self, bytes: &[u8]) {
        self.unread.extend_from_slice(bytes);
    }

    /// Number of bytes after the last frame that was taken.
    pub fn unread(&self) -> usize {
        self.unread.len()
    }

    /// The next frame; `None` while it is incomplete.
    ///
    /// # Errors
    /// When it is too large or breaks the rules of WebSockets.
    pub fn take(&mut self) -> Result<Option<Frame>, ProtocolError> {
        let frame = self.codec.decode(&mut self.unread)?;
        // The codec knows only the highest limit, and reports a frame that is too large only once it is complete.
        let is_too_large = match &frame {
            Some(frame) => length(frame) > self.max(),
            None => self.unread.len() > self.max() + FRAME_HEADER,
        };
        if is_too_large {
            return Err(ProtocolError::Overflow);
        }
        Ok(frame)
    }
}

/// The length of what a frame carries, in bytes.
fn length(frame: &Frame) -> usize {
    match frame {
        Frame::Text(content) | Frame::Binary(content) | Frame::Ping(content) | Frame::Pong(content) => content.len(),
        Frame::Continuation(
            Item::FirstText(piece) | Item::FirstBinary(piece) | Item::Continue(piece) | Item::Last(piece),
        ) => piece.len(),
        Frame::Close(_) => 0,
    }
}

/// The complete messages of a client. A text that is not UTF-8 becomes binary, and a broken connection a close message.
///
/// Bytes are read only after all earlier messages were taken: actix's own stream reads on while messages wait, so that
/// one client could fill the memory.
fn messages(payload: Payload, limit: MessageLimit) -> impl Stream<Item = Result<Message, ProtocolError>> {
    let state = (payload, FrameReader::new(limit), BytesMut::new());
    stream::unfold(state, async |(mut payload, mut frames, mut partial)| {
        let message = loop {
            match frames.take() {
                Ok(Some(frame)) => {
                    if let Some(message) = complete(frame, &mut partial, frames.max()).transpose() {
                        break message;
                    }
                }
                Ok(None) => match payload.next().await? {
                    Ok(bytes) => frames.add(&bytes),
                    // The connection broke without a close frame, as when a laptop is closed.
                    Err(_) => break Ok(Message::Close(None)),
                },
                Err(error) => break Err(error),
            }
        };
        Some((message, (payload, frames, partial)))
    })
}

/// The message that a frame completes; `partial` holds the earlier frames of a fragmented text (RFC 6455, section 5.4).
/// The codec refuses frames in a wrong order.
fn complete(frame: Frame, partial: &mut BytesMut, max: usize) -> Result<Option<Message>, ProtocolError> {
    Ok(Some(match frame {
        Frame::Text(text) => text_message(text),
        Frame::Binary(data) | Frame::Continuation(Item::FirstBinary(data)) => Message::Binary(data),
        Frame::Ping(content) => Message::Ping(content),
        Frame::Pong(content) => Message::Pong(content),
        Frame::Close(reason) => Message::Close(reason),
        Frame::Continuation(Item::FirstText(piece) | Item::Continue(piece)) => {
            join(partial, &piece, max)?;
            return Ok(None);
        }
        Frame::Continuation(Item::Last(piece)) => {
            join(partial, &piece, max)?;
            text_message(partial.split().freeze())
        }
    }))
}

fn join(partial: &mut BytesMut, piece: &[u8], max: usize) -> Result<(), ProtocolError> {
    partial.extend_from_slice(piece);
    if partial.len() > max {
        Err(ProtocolError::Overflow)
    } else {
        Ok(())
    }
}

fn text_message(text: Bytes) -> Message {
    ByteString::try_from(text.clone()).map_or(Message::Binary(text), Message::Text)
}

/// The answer to a request that can't be upgraded to a WebSocket.
pub fn refuse(error: &HandshakeError) -> HttpResponse {
    HttpResponse::build(error.error_response().status()).body(format!("Error: this is a WebSocket: {error}."))
}

/// Upgrades a request to a WebSocket that the given actor serves, or answers with the error. The actor receives
/// complete messages, including invalid ones ([`wrong_message`]).
pub fn open<A>(request: &HttpRequest, payload: Payload, actor: A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    open_limited(MessageLimit::default(), request, payload, actor)
}

/// As [`open`], for messages up to a limit that the actor can raise.
pub fn open_limited<A>(limit: MessageLimit, request: &HttpRequest, payload: Payload, actor: A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    if let Some(refusal) = refuse_body(request) {
        return refusal;
    }
    match ws::handshake(request) {
        Ok(mut answer) => answer.streaming(WebsocketContext::with_factory(stream::pending(), move |ctx| {
            ctx.add_stream(messages(payload, limit));
            actor
        })),
        Err(error) => refuse(&error),
    }
}
