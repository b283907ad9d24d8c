//! A client's TCP connection that reads the next request only after the answer to the previous one has begun. A request
//! may have a body of up to 8 KiB.
//!
//! actix decodes all requests that it has read before it answers the first. Without this limit, a client that sends
//! many requests and reads no answer would fill the memory.
//!
//! Once a request was answered with 101 (Switching Protocols), the connection can be taken from actix, as
//! `hyper::upgrade` does: bytes that are only copied need no HTTP parser.

use std::cell::RefCell;
use std::io;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, ready};

use actix_http::Extensions;
use actix_web::HttpRequest;
use actix_web::rt::net::TcpStream;
use actix_web::web::{Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::oneshot;
use tokio_util::io::poll_read_buf;

use super::limits::ConnectionPermit;
use super::routing::MAX_BODY;

/// Size of one read from the socket, in bytes.
const READ_AT_ONCE: usize = 4 * 1024;
/// Start of the answer that upgrades a connection to a WebSocket.
const SWITCHING_PROTOCOLS: &[u8] = b"HTTP/1.1 101 ";
/// Size limit of the head of a request, in bytes: actix refuses one that is as large.
const MAX_HEAD: usize = 128 * 1024;
/// Limit of headers in a request, the same as that of actix.
const MAX_HEADERS: usize = 96;

/// What the connection is currently used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// A request may be read.
    Request,
    /// A request was read, and nothing of its answer was written yet.
    Answer,
    /// Messages go in both directions.
    WebSocket,
}

/// A connection that was upgraded from HTTP to another protocol.
#[derive(Debug)]
pub struct Upgraded {
    /// The connection.
    pub tcp: TcpStream,
    /// The bytes that were read after the request.
    pub read_buffer: Bytes,
    /// Counts the connection.
    pub permit: ConnectionPermit,
}

/// Receives the connection when it is upgraded; `None` if no handler waits for it.
type UpgradeSlot = Rc<RefCell<Option<oneshot::Sender<Upgraded>>>>;

/// The connection of a request, once the answer 101 was written to it. An error means that it ended before that.
pub fn upgrade(request: &HttpRequest) -> oneshot::Receiver<Upgraded> {
    let (sender, receiver) = oneshot::channel();
    if let Some(slot) = request.conn_data::<UpgradeSlot>() {
        slot.replace(Some(sender));
    }
    receiver
}

/// A client's TCP connection.
#[derive(Debug)]
pub struct ClientStream {
    /// The connection and its count. `None` once it was handed over.
    connection: Option<(TcpStream, ConnectionPermit)>,
    upgrade: UpgradeSlot,
    /// Bytes that were read from the socket and not yet passed to actix.
    unread: BytesMut,
    /// Number of bytes of the current request that were not yet passed to actix.
    left: usize,
    /// Whether the socket's send buffer is full, because the client does not read.
    is_blocked: bool,
    state: State,
}

impl ClientStream {
    /// A connection that `permit` counts.
    pub fn new(tcp: TcpStream, permit: ConnectionPermit) -> Self {
        Self {
            connection: Some((tcp, permit)),
            upgrade: UpgradeSlot::default(),
            unread: BytesMut::new(),
            left: 0,
            is_blocked: false,
            state: State::Request,
        }
    }

    /// Called by actix for each new connection, so that its requests find its upgrade slot.
    pub fn on_connect(&self, data: &mut Extensions) {
        data.insert(Rc::clone(&self.upgrade));
    }

    fn tcp(&mut self) -> io::Result<Pin<&mut TcpStream>> {
        let connection = self.connection.as_mut().map(|(tcp, _)| Pin::new(tcp));
        connection.ok_or_else(|| io::ErrorKind::NotConnected.into())
    }

    /// Reads more from the socket. Returns the number of bytes; 0 at its end.
    fn poll_fill(&mut self, context: &mut Context<'_>) -> Poll<io::Result<usize>> {
        let Some((tcp, _)) = &mut self.connection else {
            return Poll::Ready(Ok(0));
        };
        self.unread.reserve(READ_AT_ONCE);
        poll_read_buf(Pin::new(tcp), context, &mut self.unread)
    }

    /// Reads the head of a request. Returns the length of the request; 0 if the client sends no more.
    fn poll_head(&mut self, context: &mut Context<'_>) -> Poll<io::Result<usize>> {
        loop {
            if let Some(length) = request_length(&self.unread) {
                return Poll::Ready(Ok(length));
            }
            if ready!(self.poll_fill(context))? == 0 {
                return Poll::Ready(Ok(0));
            }
        }
    }
}

/// The length of the request at the start of these bytes; `None` while its head is incomplete. If the head is invalid
/// or too large, the request is all bytes, and actix answers with the error.
fn request_length(bytes: &[u8]) -> Option<usize> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Complete(head)) => Some(head + body_length(request.headers).unwrap_or(0)),
        Ok(httparse::Status::Partial) => (bytes.len() >= MAX_HEAD).then_some(bytes.len()),
        Err(_) => Some(bytes.len()),
    }
}

/// The length of a body, if the headers have one and it is not too large.
fn body_length(headers: &[httparse::Header<'_>]) -> Option<usize> {
    let header = headers
        .iter()
        .find(|header| header.name.eq_ignore_ascii_case("content-length"))?;
    std::str::from_utf8(header.value)
        .ok()?
        .trim()
        .parse()
        .ok()
        .filter(|length| *length <= MAX_BODY)
}

impl AsyncRead for ClientStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.connection.is_none() {
            // End of input: the connection was handed over.
            return Poll::Ready(Ok(()));
        }
        if self.is_blocked || self.upgrade.borrow().is_some() {
            // The next write wakes the task, or the socket does once it accepts more.
            return Poll::Pending;
        }
        if self.left == 0 {
            match self.state {
                State::Answer => return Poll::Pending,
                State::Request => {
                    self.left = ready!(self.poll_head(context))?;
                    if self.left == 0 {
                        return Poll::Ready(Ok(()));
                    }
                    self.state = State::Answer;
                }
                State::WebSocket if self.unread.is_empty() => return self.tcp()?.poll_read(context, buffer),
                State::WebSocket => self.left = self.unread.len(),
            }
        }
        if self.unread.is_empty() {
            ready!(self.poll_fill(context))?;
        }
        let count = self.left.min(self.unread.len()).min(buffer.remaining());
        buffer.put_slice(&self.unread.split_to(count));
        self.left -= count;
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for ClientStream {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = self.tcp()?.poll_write(context, bytes);
        self.is_blocked = written.is_pending();
        if self.state == State::Answer && written.is_ready() {
            self.state = State::Request;
            if bytes.starts_with(SWITCHING_PROTOCOLS) {
                self.state = State::WebSocket;
                // Thousands of WebSockets are open at a time, and most of them are idle.
                self.unread = BytesMut::from(&*self.unread);
            }
            context.waker().wake_by_ref();
        }
        written
    }

    /// actix calls this when all of an answer is written.
    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        if let Some(taker) = self.upgrade.take()
            && let Some((tcp, permit)) = self.connection.take()
        {
            let read_buffer = self.unread.split().freeze();
            // Without a receiver the connection closes.
            taker
                .send(Upgraded {
                    tcp,
                    read_buffer,
                    permit,
                })
                .ok();
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
