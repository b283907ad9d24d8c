//! One stream between a client and its Webots. The bytes are copied as they are: frames, their kinds and close codes are not
//! parsed. Each direction is read only as fast as the other end takes it.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};

use actix_web::web::Bytes;

use super::view_requests::ViewRequests;

/// How many times a direction is read before other streams have their turn.
const MAX_READS: usize = 16;

/// A connection that does not block, and what was read of it already.
pub type Connection = (TcpStream, Bytes);

/// The two ends of a stream.
#[derive(Debug, Clone, Copy)]
pub enum End {
    /// The client.
    Client,
    /// Webots.
    Webots,
}

/// A stream.
pub struct Stream {
    client: TcpStream,
    webots: TcpStream,
    up: Direction,
    down: Direction,
    /// Of a client that can only request a kind of stream.
    view_requests: Option<ViewRequests>,
    /// Dropped with the stream.
    _held: Box<dyn Send>,
}

struct Direction {
    /// What was read and is not yet written.
    pending: Bytes,
    source: Source,
    /// Whether something was read.
    has_begun: bool,
    has_ended: bool,
}

/// What can be read, as far as epoll has reported it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// Nothing.
    Empty,
    /// Something, perhaps.
    Readable,
    /// All up to the end, for it has closed.
    Closed,
}

impl Stream {
    /// A stream between these. A client that is `read_only` can only request a kind of stream. `held` is dropped with it.
    ///
    /// # Errors
    /// When such a client has closed its end already, or violates the protocol.
    pub fn new(
        (client, mut sent): Connection,
        (webots, answered): Connection,
        read_only: bool,
        held: Box<dyn Send>,
    ) -> io::Result<Self> {
        let mut view_requests = read_only.then(ViewRequests::default);
        if let Some(requests) = &mut view_requests {
            sent = requests.filter(&sent, !answered.is_empty())?;
        }
        let (up, down) = (Direction::new(sent), Direction::new(answered));
        Ok(Self { client, webots, up, down, view_requests, _held: held })
    }

    /// The connection of an end.
    pub fn connection(&self, end: End) -> &TcpStream {
        match end {
            End::Client => &self.client,
            End::Webots => &self.webots,
        }
    }

    /// Notes what epoll reports of an end.
    pub fn note(&mut self, end: End, source: Source) {
        let direction = match end {
            End::Client => &mut self.up,
            End::Webots => &mut self.down,
        };
        direction.source = direction.source.max(source);
    }

    /// Copies what can be copied in both directions. Returns whether it was interrupted for other streams to have their turn.
    pub fn copy(&mut self, buffer: &mut [u8]) -> bool {
        let down = self.down.copy(&self.webots, &self.client, None, buffer);
        let requests = self.view_requests.as_mut().map(|requests| (requests, self.down.has_begun));
        let up = self.up.copy(&self.client, &self.webots, requests, buffer);
        up || down
    }

    /// Whether a direction has ended.
    pub fn is_closing(&self) -> bool {
        self.up.has_ended || self.down.has_ended
    }

    /// Whether both directions have ended.
    pub fn has_ended(&self) -> bool {
        self.up.has_ended && self.down.has_ended
    }
}

impl Direction {
    /// A direction of which this was read before the stream began.
    fn new(pending: Bytes) -> Self {
        Self { source: Source::Readable, has_begun: !pending.is_empty(), has_ended: false, pending }
    }

    fn copy(
        &mut self,
        from: &TcpStream,
        to: &TcpStream,
        requests: Option<(&mut ViewRequests, bool)>,
        buffer: &mut [u8],
    ) -> bool {
        if self.has_ended {
            return false;
        }
        self.try_copy(from, to, requests, buffer).unwrap_or_else(|_| {
            self.has_ended = true;
            // An error: it has closed, too.
            to.shutdown(Shutdown::Write).ok();
            false
        })
    }

    /// An error means that this direction has ended.
    fn try_copy(
        &mut self,
        from: &TcpStream,
        to: &TcpStream,
        mut requests: Option<(&mut ViewRequests, bool)>,
        buffer: &mut [u8],
    ) -> io::Result<bool> {
        for _ in 0..MAX_READS {
            let written = write(to, &self.pending)?;
            drop(self.pending.split_to(written));
            if !self.pending.is_empty() || self.source == Source::Empty {
                return Ok(false);
            }
            let length = self.read(from, buffer)?;
            let read = buffer.get(..length).unwrap_or_default();
            let passed = requests.as_mut().map(|(requests, has_answered)| requests.filter(read, *has_answered));
            let passed = passed.transpose()?;
            let passed = passed.as_deref().unwrap_or(read);
            let written = write(to, passed)?;
            let rest = passed.get(written..).unwrap_or_default();
            if !rest.is_empty() {
                self.pending = Bytes::copy_from_slice(rest);
            }
        }
        Ok(true)
    }

    /// Returns how much was read: nothing if the source has to be waited for.
    fn read(&mut self, mut from: &TcpStream, buffer: &mut [u8]) -> io::Result<usize> {
        match from.read(buffer) {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Ok(length) => {
                // epoll reports what comes after a read that did not fill the buffer.
                if length < buffer.len() && self.source == Source::Readable {
                    self.source = Source::Empty;
                }
                self.has_begun = true;
                Ok(length)
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                self.source = Source::Empty;
                Ok(0)
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => Ok(0),
            Err(error) => Err(error),
        }
    }
}

/// Writes as much as a connection takes. Returns how much that is.
fn write(mut to: &TcpStream, bytes: &[u8]) -> io::Result<usize> {
    let mut written = 0;
    while let Some(rest) = bytes.get(written..).filter(|rest| !rest.is_empty()) {
        match to.write(rest) {
            Ok(0) => return Err(ErrorKind::WriteZero.into()),
            Ok(length) => written += length,
            Err(error) if error.kind() == ErrorKind::WouldBlock => break,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(written)
}
