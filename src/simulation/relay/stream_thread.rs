//! The thread that copies all streams: one epoll instance needs fewer wakeups than several, and without task wakers a
//! message costs little more than a read and a write.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use parking_lot::Mutex;

use super::stream::{Source, Stream};
use crate::shared::run::permanent;

/// Size of the buffer that all streams share, in bytes: as much is copied of a direction before other streams have their
/// turn. What an end does not take at once is kept for that stream.
const BUFFER: usize = 64 * 1024;
/// Maximum number of events per wakeup.
const MAX_EVENTS: usize = 256;

/// The thread. It ends with the process.
pub struct StreamThread {
    epoll: Epoll,
    /// By number. The epoll keys of a stream's directions are twice its number (up) and one more (down).
    streams: Mutex<HashMap<u64, Stream>>,
    next: AtomicU64,
    /// Time for which a stream remains after its Webots has ended, if its client neither takes the rest nor closes.
    rest: Duration,
}

/// The streams whose Webots has closed its end, in this order, and when each of them ends at the latest.
type Closing = VecDeque<(Instant, u64)>;

impl StreamThread {
    /// Starts it. A client has the time `rest` to take the rest of a stream and to close it after its Webots has ended.
    ///
    /// # Errors
    /// When the system allows no thread, or no epoll instance.
    pub fn start(rest: Duration) -> io::Result<Arc<Self>> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let started = Arc::new(Self {
            epoll,
            streams: Mutex::default(),
            next: AtomicU64::new(0),
            rest,
        });
        let thread = Arc::clone(&started);
        permanent::thread("streams", move || thread.run())?;
        Ok(started)
    }

    /// Copies a stream until both directions have ended.
    ///
    /// # Errors
    /// When the system can't watch its connections.
    pub fn add(&self, stream: Stream) -> io::Result<()> {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let mut streams = self.streams.lock();
        for (key, direction) in [(number << 1, &stream.up), (number << 1 | 1, &stream.down)] {
            let flags = EpollFlags::EPOLLIN | EpollFlags::EPOLLOUT | EpollFlags::EPOLLRDHUP | EpollFlags::EPOLLET;
            self.epoll.add(&direction.from, EpollEvent::new(flags, key))?;
        }
        streams.insert(number, stream);
        Ok(())
    }

    fn run(&self) {
        let mut buffer = vec![0; BUFFER];
        let mut events = [EpollEvent::empty(); MAX_EVENTS];
        // The streams that continue after others had their turn.
        let mut interrupted = BTreeSet::new();
        let mut closing = Closing::new();
        loop {
            let next_end = self.end_closed(&mut closing);
            let timeout = if interrupted.is_empty() {
                next_end
            } else {
                EpollTimeout::ZERO
            };
            // A signal may interrupt it.
            let count = self.epoll.wait(&mut events, timeout).unwrap_or_default();
            let resumed = std::mem::take(&mut interrupted)
                .into_iter()
                .map(|number| (number << 1, Source::Empty));
            let reported = events
                .iter()
                .take(count)
                .map(|event| (event.data(), source(event.events())));
            for (key, source) in resumed.chain(reported) {
                if self.copy(key, source, &mut buffer, &mut closing) {
                    interrupted.insert(key >> 1);
                }
            }
        }
    }

    /// Ends the streams whose time is over. Returns the time until the next one.
    fn end_closed(&self, closing: &mut Closing) -> EpollTimeout {
        while let Some((end, number)) = closing.front() {
            let left = end.saturating_duration_since(Instant::now());
            if !left.is_zero() {
                // Rounded up, so that the time is over when the wait ends.
                return EpollTimeout::try_from(left + Duration::from_millis(1)).unwrap_or(EpollTimeout::MAX);
            }
            self.streams.lock().remove(number);
            closing.pop_front();
        }
        EpollTimeout::NONE
    }

    /// Copies the stream of the direction with this key, for which epoll has reported `source`. Returns whether that
    /// was interrupted.
    fn copy(&self, key: u64, source: Source, buffer: &mut [u8], closing: &mut Closing) -> bool {
        let mut streams = self.streams.lock();
        let Some(stream) = streams.get_mut(&(key >> 1)) else {
            return false;
        };
        if key & 1 == 0 {
            stream.up.note(source);
        } else if stream.down.note(source) {
            closing.push_back((Instant::now() + self.rest, key >> 1));
        }
        let is_interrupted = stream.copy(buffer);
        if stream.has_ended() {
            streams.remove(&(key >> 1));
        }
        is_interrupted
    }
}

/// What can be read from a connection for which epoll reports these events.
fn source(events: EpollFlags) -> Source {
    if events.intersects(EpollFlags::EPOLLRDHUP | EpollFlags::EPOLLHUP | EpollFlags::EPOLLERR) {
        Source::Closed
    } else if events.contains(EpollFlags::EPOLLIN) {
        Source::Readable
    } else {
        Source::Empty
    }
}
