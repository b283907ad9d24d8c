//! A client's TCP connection that reads the next request only after the answer to the previous one has begun. A request
//! may have a body of up to 8 KiB whose length its head tells. After a head that announces a body of unknown length
//! (`Transfer-Encoding`) nothing more is read, and the connection ends with the answer: actix would wait for the end of
//! that body without a time limit.
//!
//! actix decodes all requests that it has read before it answers the first. Without this limit, a client that sends
//! many requests and reads no answer would fill the memory.
//!
//! A [`Router`] may tell that a request is for another process of the server, or the first message on a WebSocket. Then
//! that process gets the connection, with what was read and not answered, and here it has ended.
//!
//! Once a request was answered with 101 (Switching Protocols), the connection can be taken from actix, as
//! `hyper::upgrade` does: bytes that are only copied need no HTTP parser.

use std::cell::RefCell;
use std::io;
use std::path::PathBuf;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use actix_http::Extensions;
use actix_http::ws::Frame;
use actix_web::HttpRequest;
use actix_web::rt::net::TcpStream;
use actix_web::web::{Buf, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::oneshot;
use tokio_util::io::poll_read_buf;

use super::limits::ConnectionPermit;
use super::passing::{self, Owner, Router, ServedSoFar};
use super::routing::MAX_BODY;
use super::websocket::FrameReader;

/// Size of one read from the socket, in bytes.
const READ_AT_ONCE: usize = 4 * 1024;
/// Start of the answer that upgrades a connection to a WebSocket.
const SWITCHING_PROTOCOLS: &[u8] = b"HTTP/1.1 101 ";
/// Size limit of the head of a request, in bytes: actix refuses one that is as large.
const MAX_HEAD: usize = 128 * 1024;
/// Length of the end of a head that shows that it is one: an empty line, after the end of another.
const END_OF_HEAD: usize = 3;
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
    /// Nothing is read any more. The answer to the last request may still be written.
    Ended,
}

/// The beginning of the unread bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Front {
    /// A request of this length, with its body.
    Request(usize),
    /// The head of the last request on this connection, of this length.
    Last(usize),
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
pub struct ClientStream {
    /// The connection and its count. `None` once it was handed over.
    connection: Option<(TcpStream, ConnectionPermit)>,
    upgrade: UpgradeSlot,
    /// Bytes that were read from the socket and not yet passed to actix.
    unread: BytesMut,
    heads: HeadFinder,
    /// Number of bytes of the current request that were not yet passed to actix.
    left: usize,
    /// Whether the socket's send buffer is full, because the client does not read.
    is_blocked: bool,
    state: State,
    router: Option<Arc<dyn Router>>,
    /// The head of the request for a WebSocket, until its first message tells whose it is.
    handshake: Option<BytesMut>,
    /// Whether the client has the answer to its request for a WebSocket from another process.
    is_answered: bool,
}

/// What the first message on a WebSocket tells.
enum First {
    /// These bytes come before it.
    After(usize),
    /// It is for this process.
    Here,
    /// It is for another process, which gets the connection.
    Passed,
}

impl ClientStream {
    /// A connection that `permit` counts.
    pub fn new(tcp: TcpStream, permit: ConnectionPermit, router: Option<Arc<dyn Router>>) -> Self {
        Self {
            connection: Some((tcp, permit)),
            router,
            handshake: None,
            is_answered: false,
            upgrade: UpgradeSlot::default(),
            unread: BytesMut::new(),
            heads: HeadFinder::default(),
            left: 0,
            is_blocked: false,
            state: State::Request,
        }
    }

    /// Goes on with a connection that another process has passed.
    pub(super) fn going_on(mut self, progress: ServedSoFar) -> Self {
        self.unread = progress.unread;
        self.is_answered = progress.is_answered;
        self
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

    /// Reads the head of a request; `None` if the client sends no more.
    fn poll_head(&mut self, context: &mut Context<'_>) -> Poll<io::Result<Option<Front>>> {
        loop {
            if let Some(front) = self.heads.find(&mut self.unread) {
                return Poll::Ready(Ok(Some(front)));
            }
            if ready!(self.poll_fill(context))? == 0 {
                return Poll::Ready(Ok(None));
            }
        }
    }
}

impl ClientStream {
    /// Passes the connection on if the request at the start of the unread bytes, with a head of this length, is for another
    /// process.
    fn is_passed(&mut self, length: usize) -> bool {
        let Some(router) = &self.router else { return false };
        let owner = path(&self.unread).map_or(Owner::This, |path| router.request(path));
        self.handshake = None;
        match owner {
            Owner::This => false,
            Owner::OfFirstMessage => {
                self.handshake = self.unread.get(..length).map(BytesMut::from);
                false
            }
            Owner::Other(folder) => {
                let unread = self.unread.split();
                self.pass(folder, unread, self.is_answered);
                true
            }
        }
    }

    fn pass(&mut self, folder: PathBuf, unread: BytesMut, is_answered: bool) {
        let Some((tcp, permit)) = self.connection.take() else {
            return;
        };
        let progress = ServedSoFar { unread, is_answered };
        actix_web::rt::spawn(async move {
            if let Err(error) = passing::pass(&folder, &tcp, &progress).await {
                log::warn!("a connection is lost, the process that serves it has ended: {error}");
            }
            drop(permit);
        });
    }

    /// Reads the first message on a WebSocket, and passes the connection on if it is for another process.
    fn poll_first_message(&mut self, context: &mut Context<'_>) -> Poll<io::Result<First>> {
        loop {
            let mut frames = FrameReader::default();
            frames.add(&self.unread);
            let mut before = 0;
            loop {
                match frames.take() {
                    Ok(Some(Frame::Ping(_) | Frame::Pong(_))) => before = self.unread.len() - frames.unread(),
                    Ok(Some(Frame::Text(text))) => {
                        let text = std::str::from_utf8(&text).unwrap_or_default();
                        let other = self.router.as_ref().and_then(|router| router.message(text));
                        let Some((folder, mut head)) = other.zip(self.handshake.take()) else {
                            return Poll::Ready(Ok(First::Here));
                        };
                        head.extend_from_slice(&self.unread.split());
                        self.pass(folder, head, true);
                        return Poll::Ready(Ok(First::Passed));
                    }
                    Ok(None) => break,
                    // Whoever serves it answers that.
                    Ok(Some(_)) | Err(_) => return Poll::Ready(Ok(First::Here)),
                }
            }
            if before > 0 {
                return Poll::Ready(Ok(First::After(before)));
            }
            if ready!(self.poll_fill(context))? == 0 {
                return Poll::Ready(Ok(First::Here));
            }
        }
    }

    /// Passes the answer to a WebSocket that the client has already by, and returns its length.
    fn skip_answer(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n");
        let end = end.filter(|_| bytes.starts_with(SWITCHING_PROTOCOLS));
        // It is refused here: the client has its WebSocket, and connects again.
        let end = end.ok_or(io::ErrorKind::ConnectionAborted)?;
        self.is_answered = false;
        self.state = State::WebSocket;
        Ok(end + 4)
    }
}

/// The path of the request at the start of these bytes.
fn path(bytes: &[u8]) -> Option<&str> {
    let line = bytes.split(|byte| *byte == b'\n').next()?;
    std::str::from_utf8(line).ok()?.split(' ').nth(1)
}

/// Finds the head of a request at the start of bytes that arrive piece by piece.
///
/// What is no HTTP at all, such as TLS, is recognized in the first piece. After that the head is parsed once, when its
/// last line has arrived: a client may send it byte by byte.
#[derive(Debug, Default)]
struct HeadFinder {
    /// Number of bytes in which no head ends.
    searched: usize,
}

impl HeadFinder {
    /// The request at the start of these bytes, which are those of the last call and more; `None` while its head is
    /// incomplete. If the head is invalid or too large, the request is all bytes, and actix answers with the error.
    fn find(&mut self, bytes: &mut BytesMut) -> Option<Front> {
        if self.searched == 0 {
            // Empty lines before a request are ignored (RFC 9112, section 2.2).
            let is_empty = |byte: &&u8| matches!(byte, b'\r' | b'\n');
            let empty = bytes.iter().take_while(is_empty).count();
            bytes.advance(empty);
        }
        let new = bytes.get(self.searched.saturating_sub(END_OF_HEAD - 1)..);
        let is_worth_parsing = self.searched == 0 || bytes.len() >= MAX_HEAD || new.is_some_and(ends_head);
        self.searched = bytes.len();
        let front = (is_worth_parsing && !bytes.is_empty()).then(|| parse(bytes)).flatten();
        if front.is_some() {
            self.searched = 0;
        }
        front
    }
}

fn parse(bytes: &[u8]) -> Option<Front> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Complete(head)) if has_transfer_encoding(request.headers) => Some(Front::Last(head)),
        Ok(httparse::Status::Complete(head)) => Some(Front::Request(head + body_length(request.headers).unwrap_or(0))),
        Ok(httparse::Status::Partial) => (bytes.len() >= MAX_HEAD).then_some(Front::Request(bytes.len())),
        Err(_) => Some(Front::Request(bytes.len())),
    }
}

/// Whether a head may end in these bytes: an empty line follows a line. The parser also takes lines without a carriage
/// return.
fn ends_head(bytes: &[u8]) -> bool {
    bytes.windows(2).any(|two| two == b"\n\n") || bytes.windows(3).any(|three| three == b"\n\r\n")
}

fn has_transfer_encoding(headers: &[httparse::Header<'_>]) -> bool {
    headers
        .iter()
        .any(|header| header.name.eq_ignore_ascii_case("transfer-encoding"))
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
                State::Ended => return Poll::Ready(Ok(())),
                State::Request => match ready!(self.poll_head(context))? {
                    None => return Poll::Ready(Ok(())),
                    Some(Front::Request(length) | Front::Last(length)) if self.is_passed(length) => {
                        return Poll::Ready(Ok(()));
                    }
                    Some(Front::Request(length)) => {
                        self.left = length;
                        self.state = State::Answer;
                    }
                    Some(Front::Last(length)) => {
                        self.left = length;
                        self.state = State::Ended;
                    }
                },
                State::WebSocket if self.handshake.is_some() => match ready!(self.poll_first_message(context))? {
                    First::Passed => return Poll::Ready(Ok(())),
                    First::After(length) => self.left = length,
                    First::Here => {
                        self.handshake = None;
                        self.left = self.unread.len();
                    }
                },
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
        if self.is_answered && self.state == State::Answer {
            context.waker().wake_by_ref();
            return Poll::Ready(self.skip_answer(bytes));
        }
        let written = self.tcp()?.poll_write(context, bytes);
        self.is_blocked = written.is_pending();
        if self.state == State::Answer && written.is_ready() {
            self.state = State::Request;
            if bytes.starts_with(SWITCHING_PROTOCOLS) {
                self.state = State::WebSocket;
                // Thousands of WebSockets are open at a time, and most of them are idle.
                self.unread = BytesMut::from(&*self.unread);
            } else {
                self.handshake = None;
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

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    /// Where the request at the start is complete, if it arrives in pieces of this size.
    fn found(text: &str, size: usize) -> Option<(Front, usize)> {
        let mut heads = HeadFinder::default();
        let mut bytes = BytesMut::new();
        let mut arrived = 0;
        text.as_bytes().chunks(size).find_map(|piece| {
            arrived += piece.len();
            bytes.extend_from_slice(piece);
            heads.find(&mut bytes).map(|front| (front, arrived))
        })
    }

    #[test]
    fn a_head_is_found_however_it_arrives() {
        let long = format!("GET / HTTP/1.1\r\nX: {}\r\n\r\n", "x".repeat(5000));
        let too_large = format!("GET / HTTP/1.1\r\nX: {}", "x".repeat(MAX_HEAD));
        for (text, front) in [
            ("GET / HTTP/1.1\r\n\r\n", Front::Request(18)),
            ("GET / HTTP/1.1\nHost: x\n\n", Front::Request(24)),
            ("GET / HTTP/1.1\nHost: x\r\n\n", Front::Request(25)),
            (&long, Front::Request(long.len())),
            ("POST / HTTP/1.1\r\nContent-Length: 4\r\n\r\n", Front::Request(42)),
            ("POST / HTTP/1.1\r\nContent-Length: 9000\r\n\r\n", Front::Request(41)),
            ("GET / HTTP/1.1\r\ntransfer-encoding: chunked\r\n\r\n", Front::Last(46)),
        ] {
            for size in [1, 2, 3, 7, 4096, usize::MAX] {
                assert_eq!(found(text, size), Some((front, text.len())), "{text:?} by {size}");
                let (cut, _) = text.split_at(text.len() - 1);
                assert_eq!(found(cut, size), None, "{text:?} by {size}");
            }
            let after_empty_lines = format!("\r\n\n{text}");
            assert_eq!(found(&after_empty_lines, 1), Some((front, after_empty_lines.len())));
        }
        assert_eq!(found(&too_large, 4096), Some((Front::Request(MAX_HEAD), MAX_HEAD)));
        assert_eq!(found("\x16\x03\x01", 3), Some((Front::Request(3), 3)), "TLS");
        assert_eq!(found(&"\r\n".repeat(1000), 7), None);
    }

    #[test]
    fn a_head_that_arrives_byte_by_byte_costs_little() {
        let begin = Instant::now();
        let head = format!(
            "GET / HTTP/1.1\r\n{}",
            format!("X: {}\r\n", "x".repeat(1000)).repeat(80)
        );
        assert_eq!(found(&head, 1), None);
        assert_eq!(found(&"\r\n".repeat(60_000), 1), None);
        assert!(begin.elapsed() < Duration::from_secs(1), "{:?}", begin.elapsed());
    }
}
