//! The thread that copies all streams: one epoll instance serves them with fewer wakeups than several, and without the wakers
//! of tasks a message costs little more than a read and a write.

use std::collections::{HashMap, VecDeque};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use parking_lot::Mutex;

use super::stream::{End, Progress, Source, Stream};

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
        let thread = Arc::clone(&shared);
        std::thread::Builder::new().name("streams".to_owned()).spawn(move || thread.run())?;
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

impl Shared {
    fn run(&self) {
        let mut buffer = vec![0; BUFFER];
        let mut events = [EpollEvent::empty(); MAX_EVENTS];
        let mut closing: VecDeque<(Instant, u64)> = VecDeque::new();
        let mut interrupted: Vec<u64> = Vec::new();
        loop {
            let timeout = if interrupted.is_empty() { until_first(&closing) } else { EpollTimeout::ZERO };
            // A signal may interrupt it.
            let count = self.epoll.wait(&mut events, timeout).unwrap_or_default();
            let mut copy = |number: u64, event: Option<EpollEvent>, again: &mut Vec<u64>| {
                let mut streams = self.streams.lock();
                let Some(stream) = streams.get_mut(&number) else { return };
                if let Some(event) = event {
                    let end = if event.data() & 1 == 0 { End::Client } else { End::Webots };
                    stream.note(end, source(event.events()));
                }
                let was_closing = stream.is_closing();
                match stream.copy(&mut buffer) {
                    Progress::Ended => {
                        let ended = streams.remove(&number);
                        drop(streams);
                        drop(ended);
                        return;
                    }
                    Progress::Interrupted => again.push(number),
                    Progress::Waiting => {}
                }
                if !was_closing && stream.is_closing() {
                    closing.push_back((Instant::now() + CLOSE_TIMEOUT, number));
                }
            };
            let mut again = Vec::new();
            for number in interrupted {
                copy(number, None, &mut again);
            }
            for event in events.into_iter().take(count) {
                copy(event.data() >> 1, Some(event), &mut again);
            }
            interrupted = again;
            self.remove_late(&mut closing);
        }
    }

    /// Removes streams whose second direction has not ended in time.
    fn remove_late(&self, closing: &mut VecDeque<(Instant, u64)>) {
        while let Some((_, number)) = closing.pop_front_if(|(deadline, _)| *deadline <= Instant::now()) {
            let late = self.streams.lock().remove(&number);
            drop(late);
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
