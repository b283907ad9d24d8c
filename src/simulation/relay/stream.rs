//! One stream between a client and its Webots. The bytes are copied as they are, except for the last frame of a simulation
//! that the server ends; once a second the time of an update is looked for. Each direction is read only as fast as the
//! other end takes it.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, OnceLock};

use actix_web::web::Bytes;

use super::frames::Frames;
use crate::simulation::simulated_time::{SimulatedTime, StreamId};

/// A stream.
pub struct Stream {
    /// From the client to Webots.
    pub up: Direction,
    /// From Webots to the client.
    pub down: Direction,
    /// What Webots sends.
    frames: Frames,
    /// Why the server ends the simulation, once it does.
    ending: Arc<OnceLock<String>>,
    /// How fast the simulation runs, as what it sends tells.
    time: SimulatedTime,
    id: StreamId,
    /// Dropped with the stream.
    _held: Box<dyn Send>,
}

/// A direction of a stream.
pub struct Direction {
    /// The connection to read from; it does not block.
    pub from: TcpStream,
    /// Data that was read and is not yet written.
    pending: Bytes,
    source: Source,
    has_ended: bool,
}

/// What can be read, as far as epoll has reported it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// Nothing.
    Empty,
    /// Something, perhaps.
    Readable,
    /// Everything up to the end: the connection has closed.
    Closed,
}

impl Stream {
    /// A stream with these directions, of a simulation with this time. `ending` tells why the server ends the simulation;
    /// `held` is dropped with the stream.
    pub fn new(
        up: Direction,
        down: Direction,
        (ending, time): (Arc<OnceLock<String>>, SimulatedTime),
        held: Box<dyn Send>,
    ) -> Self {
        let mut frames = Frames::default();
        frames.pass(&down.pending, None);
        Self {
            up,
            down,
            frames,
            ending,
            time,
            id: StreamId(rand::random()),
            _held: held,
        }
    }

    /// Copies up to a buffer in each direction, without waiting. Returns whether more can be copied once other streams have
    /// had their turn.
    pub fn copy(&mut self, buffer: &mut [u8]) -> bool {
        let ending = self.ending.get().map(String::as_str);
        let frames = Some((&mut self.frames, ending));
        let (down, length) = self.down.copy(&self.up.from, frames, buffer);
        if self.down.pending.is_empty() {
            self.time.read(self.id, buffer.get(..length).unwrap_or_default());
        } else {
            self.time.interrupt(self.id);
        }
        let (up, _) = self.up.copy(&self.down.from, None, buffer);
        up || down
    }

    /// Whether both directions have ended.
    pub fn has_ended(&self) -> bool {
        self.up.has_ended && self.down.has_ended
    }
}

impl Direction {
    /// Reads from this connection; `pending` was read from it already.
    pub fn new(from: TcpStream, pending: Bytes) -> Self {
        Self {
            from,
            pending,
            source: Source::Readable,
            has_ended: false,
        }
    }

    /// Notes what epoll reports. Returns whether the connection has just closed.
    pub fn note(&mut self, source: Source) -> bool {
        let has_closed = source == Source::Closed && self.source != Source::Closed;
        self.source = self.source.max(source);
        has_closed
    }

    /// Returns whether more can be copied, and the number of bytes that were read into the buffer.
    fn copy(
        &mut self,
        to: &TcpStream,
        frames: Option<(&mut Frames, Option<&str>)>,
        buffer: &mut [u8],
    ) -> (bool, usize) {
        if self.has_ended {
            return (false, 0);
        }
        self.try_copy(to, frames, buffer).unwrap_or_else(|_| {
            self.has_ended = true;
            // That end then closes, and the other direction ends, too. An error: it has closed already.
            to.shutdown(Shutdown::Write).ok();
            (false, 0)
        })
    }

    /// An error means that this direction has ended.
    fn try_copy(
        &mut self,
        to: &TcpStream,
        frames: Option<(&mut Frames, Option<&str>)>,
        buffer: &mut [u8],
    ) -> io::Result<(bool, usize)> {
        let written = write(to, &self.pending)?;
        drop(self.pending.split_to(written));
        if !self.pending.is_empty() || self.source == Source::Empty {
            return Ok((false, 0));
        }
        let length = match self.from.read(buffer) {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                self.source = Source::Empty;
                return Ok((false, 0));
            }
            Ok(0) | Err(_) => {
                let close = frames.and_then(|(frames, ending)| frames.close(ending?));
                self.pending = close.ok_or(ErrorKind::UnexpectedEof)?.into();
                return Ok((true, 0));
            }
            Ok(length) => length,
        };
        // epoll reports what comes after a read that did not fill the buffer.
        if length < buffer.len() && self.source == Source::Readable {
            self.source = Source::Empty;
        }
        let read = buffer.get(..length).unwrap_or_default();
        let read = match frames {
            Some((frames, ending)) => frames.pass(read, ending),
            None => read.into(),
        };
        let written = write(to, &read)?;
        let rest = read.get(written..).unwrap_or_default();
        self.pending = Bytes::copy_from_slice(rest);
        Ok((rest.is_empty() && self.source != Source::Empty, length))
    }
}

/// Writes as much as possible without waiting, and returns how much; epoll reports when the connection takes more.
fn write(mut to: &TcpStream, bytes: &[u8]) -> io::Result<usize> {
    if bytes.is_empty() {
        return Ok(0);
    }
    to.write(bytes).or_else(|error| {
        if error.kind() == ErrorKind::WouldBlock {
            Ok(0)
        } else {
            Err(error)
        }
    })
}
