//! WebSockets: opens them, and joins messages of several frames.

use std::io;

use actix::{Actor, AsyncContext, StreamHandler};
use actix_http::ws::{Codec, Frame, Item};
use actix_web::web::{Bytes, BytesMut, Payload};
use actix_web::{HttpRequest, HttpResponse, ResponseError};
use actix_web_actors::ws::{self, CloseCode, CloseReason, HandshakeError, Message, ProtocolError, WebsocketContext};
use bytestring::ByteString;
use futures_util::stream::{self, Stream, StreamExt};
use tokio_util::codec::Decoder;

use super::body;

/// Size limit of a client's message, in bytes.
const MAX_MESSAGE: usize = 8 * 1024;
/// Largest header of a WebSocket frame, in bytes (RFC 6455, section 5.2).
const FRAME_HEADER: usize = 14;

/// Reads the messages of one WebSocket, and joins those of several frames.
#[derive(Debug, Default)]
pub struct MessageReader {
    /// The frames received so far of a text whose last frame is missing (RFC 6455, section 5.4).
    partial: Option<Vec<u8>>,
}

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
            Self::NotText => CloseCode::Unsupported,
            Self::Protocol(_) => CloseCode::Protocol,
        }
    }
}

impl MessageReader {
    /// Reads a message from actix. Returns `None` while a message is incomplete.
    ///
    /// # Errors
    /// When the message is too large, is not text, or breaks the rules of WebSockets.
    pub fn read(&mut self, message: Result<Message, ProtocolError>) -> Result<Option<ClientMessage>, MessageError> {
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
}

/// Takes the frames of a client out of the bytes that it sends.
pub struct FrameReader {
    codec: Codec,
    /// What is no whole frame yet.
    unread: BytesMut,
}

impl Default for FrameReader {
    fn default() -> Self {
        Self { codec: Codec::new().max_size(MAX_MESSAGE), unread: BytesMut::new() }
    }
}

impl FrameReader {
    /// Adds bytes of the client.
    pub fn add(&mut self, bytes: &[u8]) {
        self.unread.extend_from_slice(bytes);
    }

    /// The next frame; `None` while it is incomplete.
    ///
    /// # Errors
    /// When it is too large or breaks the rules of WebSockets.
    pub fn take(&mut self) -> Result<Option<Frame>, ProtocolError> {
        let frame = self.codec.decode(&mut self.unread)?;
        // The codec tells that a frame is too large only when all of it is there.
        if frame.is_none() && self.unread.len() > MAX_MESSAGE + FRAME_HEADER {
            return Err(ProtocolError::Overflow);
        }
        Ok(frame)
    }
}

/// The messages of a client. Bytes are read only once all messages before them were taken: actix' own stream reads on
/// while messages wait, so that one client could fill the memory.
fn messages(payload: Payload) -> impl Stream<Item = Result<Message, ProtocolError>> {
    stream::unfold((payload, FrameReader::default()), async |(mut payload, mut frames)| {
        let message = loop {
            match frames.take() {
                Ok(Some(frame)) => break message(frame),
                Ok(None) => {}
                Err(error) => break Err(error),
            }
            match payload.next().await? {
                Ok(bytes) => frames.add(&bytes),
                Err(error) => break Err(ProtocolError::Io(io::Error::other(error))),
            }
        };
        Some((message, (payload, frames)))
    })
}

fn message(frame: Frame) -> Result<Message, ProtocolError> {
    Ok(match frame {
        Frame::Text(text) => Message::Text(text.try_into().map_err(io::Error::other)?),
        Frame::Binary(data) => Message::Binary(data),
        Frame::Ping(content) => Message::Ping(content),
        Frame::Pong(content) => Message::Pong(content),
        Frame::Close(reason) => Message::Close(reason),
        Frame::Continuation(item) => Message::Continuation(item),
    })
}

/// The answer to a request that can't be upgraded to a WebSocket.
pub fn refuse(error: &HandshakeError) -> HttpResponse {
    HttpResponse::build(error.error_response().status()).body(format!("Error: this is a WebSocket: {error}."))
}

/// Upgrades a request to a WebSocket that the given actor serves, or answers with the error. The actor must pass all
/// messages to a [`MessageReader`].
pub fn open<A>(request: &HttpRequest, payload: Payload, actor: A) -> HttpResponse
where
    A: Actor<Context = WebsocketContext<A>> + StreamHandler<Result<Message, ProtocolError>>,
{
    if let Some(refusal) = body::refuse(request) {
        return refusal;
    }
    match ws::handshake(request) {
        Ok(mut answer) => answer.streaming(WebsocketContext::with_factory(stream::pending(), |ctx| {
            ctx.add_stream(messages(payload));
            actor
        })),
        Err(error) => refuse(&error),
    }
}
