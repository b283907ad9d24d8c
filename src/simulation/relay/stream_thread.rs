//! The thread that copies all streams: one epoll instance serves them with fewer wakeups than several, and without the wakers
//! of tasks a message costs little more than a read and a write.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use parking_lot::Mutex;

use super::stream::{End, Source, Stream};

/// Size of the buffer that all streams share, in bytes. What one end does not take at once of it is kept for that stream.
const BUFFER: usize = 64 * 1024;
/// Timeout of the other direction once one has ended.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);
/// How many events are taken at once.
const MAX_EVENTS: usize = 256;

/// The thread. It ends with the process.
#[derive(Clone)]
pub struct StreamThread(Arc<Shared>);

struct Shared {
    epoll: Epoll,
    streams: Mutex<HashMap<u64, Stream>>,
    next: AtomicU64,
}

impl StreamThread {
    /// Starts it.
    ///
    /// # Errors
    /// When the system allows no thread, or no epoll instance.
    pub fn start() -> io::Result<Self> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let shared = Arc::new(Shared { epoll, streams: Mutex::default(), next: AtomicU64::new(0) });
        let (buffer, interrupted, closing) = (vec![0; BUFFER], BTreeSet::new(), VecDeque::new());
        let copier = Copier { shared: Arc::clone(&shared), buffer, interrupted, closing };
        std::thread::Builder::new().name("streams".to_owned()).spawn(move || {
            // Without it all streams would stand still: the service manager restarts the server.
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| copier.run())).ok();
            std::process::abort()
        })?;
        Ok(Self(shared))
    }

    /// Copies a stream until both directions have ended, or one has and the other takes too long.
    ///
    /// # Errors
    /// When the system can't watch its connections.
    pub fn add(&self, stream: Stream) -> io::Result<()> {
        let number = self.0.next.fetch_add(1, Ordering::Relaxed);
        let mut streams = self.0.streams.lock();
        for end in [End::Client, End::Webots] {
            let flags = EpollFlags::EPOLLIN | EpollFlags::EPOLLOUT | EpollFlags::EPOLLRDHUP | EpollFlags::EPOLLET;
            self.0.epoll.add(stream.connection(end), EpollEvent::new(flags, key(number, end)))?;
        }
        streams.insert(number, stream);
        Ok(())
    }
}

/// What epoll calls an end of a stream.
fn key(number: u64, end: End) -> u64 {
    number << 1 | u64::from(matches!(end, End::Webots))
}

/// What the thread itself keeps.
struct Copier {
    shared: Arc<Shared>,
    buffer: Vec<u8>,
    /// Streams that go on once others had their turn.
    interrupted: BTreeSet<u64>,
    /// Streams of which one direction has ended, and until when they have time.
    closing: VecDeque<(Instant, u64)>,
}

impl Copier {
    fn run(mut self) {
        let mut events = [EpollEvent::empty(); MAX_EVENTS];
        loop {
            let timeout = if self.interrupted.is_empty() { until_first(&self.closing) } else { EpollTimeout::ZERO };
            // A signal may interrupt it.
            let count = self.shared.epoll.wait(&mut events, timeout).unwrap_or_default();
            for number in std::mem::take(&mut self.interrupted) {
                self.copy(number, None);
            }
            for event in events.into_iter().take(count) {
                let end = if event.data() & 1 == 0 { End::Client } else { End::Webots };
                self.copy(event.data() >> 1, Some((end, source(event.events()))));
            }
            self.remove_late();
        }
    }

    /// Copies what can be copied of a stream, of which epoll has reported this.
    fn copy(&mut self, number: u64, reported: Option<(End, Source)>) {
        let mut streams = self.shared.streams.lock();
        let Some(stream) = streams.get_mut(&number) else { return };
        if let Some((end, source)) = reported {
            stream.note(end, source);
        }
        let was_closing = stream.is_closing();
        let is_interrupted = stream.copy(&mut self.buffer);
        if !was_closing && stream.is_closing() {
            self.closing.push_back((Instant::now() + CLOSE_TIMEOUT, number));
        }
        if stream.has_ended() {
            streams.remove(&number);
        } else if is_interrupted {
            self.interrupted.insert(number);
        }
    }

    /// Removes streams whose second direction has not ended in time.
    fn remove_late(&mut self) {
        while let Some((_, number)) = self.closing.pop_front_if(|(deadline, _)| *deadline <= Instant::now()) {
            drop(self.shared.streams.lock().remove(&number));
        }
    }
}

/// The time until the first deadline.
fn until_first(closing: &VecDeque<(Instant, u64)>) -> EpollTimeout {
    let Some((deadline, _)) = closing.front() else { return EpollTimeout::NONE };
    // Rounded up, so that the deadline is over then.
    let left = deadline.saturating_duration_since(Instant::now()) + Duration::from_millis(1);
    EpollTimeout::try_from(left).unwrap_or(EpollTimeout::MAX)
}

/// What can be read of an end of which epoll reports this.
fn source(events: EpollFlags) -> Source {
    if events.intersects(EpollFlags::EPOLLRDHUP | EpollFlags::EPOLLHUP | EpollFlags::EPOLLERR) {
        Source::Closed
    } else if events.contains(EpollFlags::EPOLLIN) {
        Source::Readable
    } else {
        Source::Empty
    }
}
