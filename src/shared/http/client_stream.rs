//! A client's TCP connection that reads the next request only once the answer to the one before has begun, and none
//! once the server stops. A request may have a body of up to 8 KiB.
//!
//! actix decodes all requests that it has read before it answers the first. Without this limit, a client that sends
//! many requests and reads no answer would fill the memory.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use actix_http::Extensions;
use actix_web::rt::net::TcpStream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use super::connections::ConnectionPermit;
use super::upgrade::{UpgradeSlot, Upgraded};

/// Size of one read from the socket, in bytes.
const READ_AT_ONCE: usize = 4 * 1024;
/// Begin of the answer that upgrades a connection to a WebSocket.
const SWITCHING_PROTOCOLS: &[u8] = b"HTTP/1.1 101 ";
/// Number of bytes that are kept of a line, enough for the header Content-Length.
const MAX_LINE: usize = 40;
/// Size limit of a body, in bytes. A request with a larger one, or one in chunks, is answered without it.
pub const MAX_BODY: usize = 8 * 1024;

/// What the connection is currently used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// The head of a request is read.
    Request,
    /// So many bytes of a request's body are still to come; its answer may have begun.
    Body(usize, bool),
    /// A request was handed over, and nothing of its answer was written yet.
    Answer,
    /// Messages go in both directions.
    WebSocket,
}

/// A client's TCP connection.
#[derive(Debug)]
pub struct ClientStream {
    /// The connection and its count. `None` once it was handed over.
    connection: Option<(TcpStream, ConnectionPermit)>,
    upgrade: UpgradeSlot,
    /// Bytes that were read from the socket and not yet passed to actix.
    unread: Vec<u8>,
    /// The beginning of the line that is read, without line breaks.
    line: Vec<u8>,
    /// The length of the body that the head tells; `None` before its first line.
    body: Option<usize>,
    /// Whether the system takes no more of an answer, since the client does not read.
    is_blocked: bool,
    state: State,
    /// `None` once it is a WebSocket, which its actor closes.
    stopping: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
}

impl ClientStream {
    /// A connection that `permit` counts; `stopping` is cancelled when the server stops.
    pub fn new(tcp: TcpStream, permit: ConnectionPermit, stopping: CancellationToken) -> Self {
        Self {
            connection: Some((tcp, permit)),
            upgrade: UpgradeSlot::default(),
            unread: Vec::new(),
            line: Vec::new(),
            body: None,
            is_blocked: false,
            state: State::Request,
            stopping: Some(Box::pin(stopping.cancelled_owned())),
        }
    }

    /// Called by actix for each new connection, so that its requests find its slot.
    pub fn on_connect(&self, data: &mut Extensions) {
        data.insert(self.upgrade.clone());
    }

    fn tcp(&mut self) -> io::Result<Pin<&mut TcpStream>> {
        let connection = self.connection.as_mut().map(|(tcp, _)| Pin::new(tcp));
        connection.ok_or_else(|| io::ErrorKind::NotConnected.into())
    }

    /// Frees what only requests need: thousands of WebSockets are open at a time, and most of them are idle.
    fn release(&mut self) {
        if self.state == State::WebSocket {
            self.stopping = None;
            self.line = Vec::new();
            if self.unread.is_empty() {
                self.unread = Vec::new();
            }
        }
    }

    /// Number of unread bytes that may be passed on, at most `room`: those of one request.
    fn readable(&mut self, room: usize) -> usize {
        let room = room.min(self.unread.len());
        if self.state == State::WebSocket {
            return room;
        }
        if let State::Body(left, is_answered) = self.state {
            let count = room.min(left);
            self.state = after(left - count, is_answered);
            return count;
        }
        for (index, byte) in self.unread.iter().take(room).enumerate() {
            match byte {
                // An empty line ends the head of a request, and means nothing before one.
                b'\n' if self.line.is_empty() => {
                    if let Some(body) = self.body.take() {
                        self.state = after(body, false);
                        return index + 1;
                    }
                }
                b'\n' => {
                    self.body = content_length(&self.line).or(self.body).or(Some(0));
                    self.line.clear();
                }
                b'\r' => {}
                other if self.line.len() < MAX_LINE => self.line.push(*other),
                _ => {}
            }
        }
        room
    }
}

/// The state once so many bytes of a body are left.
fn after(left: usize, is_answered: bool) -> State {
    match (left, is_answered) {
        (0, true) => State::Request,
        (0, false) => State::Answer,
        (left, _) => State::Body(left, is_answered),
    }
}

/// The length of a body, where this line of a head tells it and it is not too large.
fn content_length(line: &[u8]) -> Option<usize> {
    let (name, value) = std::str::from_utf8(line).ok()?.split_once(':')?;
    let length = value.trim().parse().ok().filter(|length| *length <= MAX_BODY)?;
    name.eq_ignore_ascii_case("content-length").then_some(length)
}

impl AsyncRead for ClientStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.connection.is_none() {
            // End of input: actix has no more to do with what was handed over.
            return Poll::Ready(Ok(()));
        }
        if self.is_blocked || self.state == State::Answer || self.upgrade.is_wanted() {
            // The next write wakes the task, or the socket once it accepts more.
            return Poll::Pending;
        }
        let is_stopping = |end: &mut Pin<Box<WaitForCancellationFutureOwned>>| end.as_mut().poll(context).is_ready();
        if self.state == State::Request && self.stopping.as_mut().is_some_and(is_stopping) {
            // End of input: requests in progress are answered, and the connection closes.
            return Poll::Ready(Ok(()));
        }
        if self.unread.is_empty() {
            if self.state == State::WebSocket {
                return self.tcp()?.poll_read(context, buffer);
            }
            let mut bytes = [0; READ_AT_ONCE];
            let mut part = ReadBuf::new(&mut bytes);
            ready!(self.tcp()?.poll_read(context, &mut part))?;
            self.unread.extend_from_slice(part.filled());
        }
        let count = self.readable(buffer.remaining());
        buffer.put_slice(self.unread.get(..count).unwrap_or_default());
        self.unread.drain(..count);
        self.release();
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for ClientStream {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = self.tcp()?.poll_write(context, bytes);
        self.is_blocked = written.is_pending();
        if let State::Body(left, _) = self.state {
            self.state = State::Body(left, true);
        }
        if self.state == State::Answer && written.is_ready() {
            self.state = if bytes.starts_with(SWITCHING_PROTOCOLS) { State::WebSocket } else { State::Request };
            self.release();
            context.waker().wake_by_ref();
        }
        written
    }

    /// actix calls this when all of an answer is written.
    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.upgrade.is_wanted()
            && let Some((tcp, permit)) = self.connection.take()
        {
            let read_buffer = std::mem::take(&mut self.unread);
            self.upgrade.fulfil(Upgraded { tcp, read_buffer, permit });
            context.waker().wake_by_ref();
        }
        // A TCP connection has nothing to flush.
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.tcp() {
            Ok(tcp) => tcp.poll_shutdown(context),
            Err(_) => Poll::Ready(Ok(())),
        }
    }
}
