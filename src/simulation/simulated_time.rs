//! How fast a simulation runs: its time against real time, as the stream of its Webots tells it.
//!
//! Streams are not parsed. Webots' updates begin with their time, so once a second the last update of what has just been
//! copied is looked for. A world can print what looks like an update: that changes what is known of its own simulation.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use memchr::memmem;
use parking_lot::Mutex;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The time of a simulation. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct SimulatedTime(Arc<Mutex<Readings>>);

#[derive(Debug, Default)]
struct Readings {
    /// Whether time passes, as the output of Webots tells. While it is paused nothing is read.
    is_running: bool,
    /// When the stream is looked at again.
    next: Option<Instant>,
    /// The stream that is read: those of several viewers may lag by different times.
    stream: Option<StreamId>,
    /// Those of the last seconds, the oldest first, without a pause between them.
    recent: VecDeque<Reading>,
    total: Total,
    /// The factor that another process of this server has told, whose simulation it is.
    told: Option<f64>,
}

/// Tells the streams of one simulation apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamId(pub u64);

/// A time that was read.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: Instant,
    /// In seconds.
    simulated: f64,
}

/// What was read in all, in seconds: while somebody looked and time passed.
#[derive(Debug, Clone, Copy, Default)]
struct Total {
    simulated: f64,
    real: f64,
    /// The part of `real` in which it ran below [`REAL_TIME`].
    slow: f64,
}

/// The factor from which a simulation counts as one that runs in real time.
pub const REAL_TIME: f64 = 0.9;

/// The beginning of an update.
const UPDATE: &[u8] = b"application/json:{\"time\":";
/// Interval between two readings.
const INTERVAL: Duration = Duration::from_secs(1);
/// Interval between two searches in a stream without updates, such as a download: they cost as much as the copy.
const SEARCH: Duration = Duration::from_millis(20);
/// The time over which the factor is taken.
const WINDOW: Duration = Duration::from_secs(5);
/// The least time over which it is.
const SHORTEST: Duration = Duration::from_millis(1500);
/// Between readings that are further apart nobody has looked.
const GAP: Duration = Duration::from_secs(5);
/// The largest factor. Beyond it the time was set, or is a forged one.
const LARGEST: f64 = 1000.0;

impl SimulatedTime {
    /// Looks for a time in a part of a stream, unless one was read just now, or another stream is read.
    pub fn read(&self, stream: StreamId, part: &[u8]) {
        let mut readings = self.0.lock();
        if !readings.is_running || part.is_empty() {
            return;
        }
        let now = Instant::now();
        if readings.next.is_some_and(|next| now < next) {
            return;
        }
        if !readings.choose(stream, now) {
            return;
        }
        let found = last_time(part);
        readings.next = Some(now + if found.is_some() { INTERVAL } else { SEARCH });
        if let Some(milliseconds) = found {
            readings.add(Reading {
                at: now,
                simulated: milliseconds / 1000.0,
            });
        }
    }

    /// The viewer of a stream takes less than Webots sends, so that it says nothing about the speed of the simulation.
    pub fn interrupt(&self, stream: StreamId) {
        let mut readings = self.0.lock();
        if readings.stream == Some(stream) {
            readings.stream = None;
            readings.recent.clear();
        }
    }

    /// Notes whether time passes, or the simulation is paused.
    pub fn set_running(&self, is_running: bool) {
        let mut readings = self.0.lock();
        if readings.is_running != is_running {
            readings.is_running = is_running;
            readings.recent.clear();
        }
    }

    /// Simulated seconds per second, of the last five seconds; `None` while it is paused, or nobody looks.
    pub fn recent(&self) -> Option<f64> {
        let readings = self.0.lock();
        readings.told.or_else(|| readings.factor(Instant::now()))
    }

    /// Simulated seconds per second while somebody looked and time passed; `None` if that was never.
    pub fn mean(&self) -> Option<f64> {
        let Total { simulated, real, .. } = self.0.lock().total;
        (real > 0.0).then(|| simulated / real)
    }

    /// The share of that time in which it ran below [`REAL_TIME`].
    pub fn slow_share(&self) -> Option<f64> {
        let Total { slow, real, .. } = self.0.lock().total;
        (real > 0.0).then(|| slow / real)
    }
}

impl<'de> Deserialize<'de> for SimulatedTime {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let readings = Readings {
            told: Option::deserialize(deserializer)?,
            ..Readings::default()
        };
        Ok(Self(Arc::new(Mutex::new(readings))))
    }
}

impl Serialize for SimulatedTime {
    /// As [`Self::recent`], in hundredths.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.recent()
            .map(|factor| (100.0 * factor).round() / 100.0)
            .serialize(serializer)
    }
}

impl Readings {
    /// Whether this stream is read: it was read last, or that one has told nothing for a while.
    fn choose(&mut self, stream: StreamId, now: Instant) -> bool {
        if self.stream == Some(stream) {
            return true;
        }
        let tells = |last: &Reading| now.saturating_duration_since(last.at) < GAP;
        if self.stream.is_some() && self.recent.back().is_some_and(tells) {
            return false;
        }
        self.stream = Some(stream);
        self.recent.clear();
        true
    }

    fn add(&mut self, next: Reading) {
        if let Some(last) = self.recent.back() {
            let (simulated, real) = (next.simulated - last.simulated, next.at - last.at);
            let factor = simulated / real.as_secs_f64();
            // A reset sets the time back.
            if (0.0..=LARGEST).contains(&factor) && real < GAP {
                self.total.simulated += simulated;
                self.total.real += real.as_secs_f64();
                if factor < REAL_TIME {
                    self.total.slow += real.as_secs_f64();
                }
            } else {
                self.recent.clear();
            }
        }
        self.recent.push_back(next);
        self.recent.retain(|one| next.at - one.at <= WINDOW);
    }

    fn factor(&self, now: Instant) -> Option<f64> {
        let (first, last) = (self.recent.front()?, self.recent.back()?);
        let real = last.at - first.at;
        let is_known = real >= SHORTEST && now.saturating_duration_since(last.at) < GAP;
        is_known.then(|| (last.simulated - first.simulated) / real.as_secs_f64())
    }
}

/// The time of the last update of a part of a stream, in milliseconds.
fn last_time(part: &[u8]) -> Option<f64> {
    let begin = memmem::rfind(part, UPDATE)? + UPDATE.len();
    let rest = part.get(begin..)?;
    let end = rest.iter().position(|byte| !matches!(byte, b'0'..=b'9' | b'.'))?;
    std::str::from_utf8(rest.get(..end)?).ok()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_whole_time_counts() {
        for (part, time) in [
            (&b"xapplication/json:{\"time\":20,\"updates\":[]}"[..], Some(20.0)),
            (
                b"application/json:{\"time\":20}\x81\x20application/json:{\"time\":40.5}",
                Some(40.5),
            ),
            (b"application/json:{\"time\":2", None),
            (b"application/json:{\"time\":,", None),
            (b"application/json:{\"time\":1e9,", Some(1.0)),
            (b"", None),
        ] {
            assert_eq!(last_time(part), time, "{}", String::from_utf8_lossy(part));
        }
    }

    /// Readings at these seconds, with these simulated seconds.
    fn read(begin: Instant, times: &[(f64, f64)]) -> Readings {
        let mut readings = Readings::default();
        for (seconds, simulated) in times {
            readings.add(Reading {
                at: begin + Duration::from_secs_f64(*seconds),
                simulated: *simulated,
            });
        }
        readings
    }

    #[test]
    fn of_several_streams_one_is_read_until_it_tells_nothing() {
        let begin = Instant::now();
        let at = |seconds: f64| begin + Duration::from_secs_f64(seconds);
        let mut readings = Readings::default();
        let mut told = |stream, seconds: f64, simulated| {
            let is_read = readings.choose(StreamId(stream), at(seconds));
            if is_read {
                readings.add(Reading {
                    at: at(seconds),
                    simulated,
                });
            }
            (is_read, readings.total.simulated)
        };
        assert_eq!(told(1, 0.0, 100.0), (true, 0.0));
        // It lags by five seconds.
        assert_eq!(told(2, 0.5, 95.5), (false, 0.0));
        assert_eq!(told(1, 1.0, 101.0), (true, 1.0));
        assert_eq!(told(2, 1.5, 96.5), (false, 1.0));
        assert_eq!(told(2, 7.0, 102.0), (true, 1.0));
        assert_eq!(told(2, 8.0, 103.0), (true, 2.0));
    }

    #[test]
    fn gaps_resets_and_forged_times_do_not_count() {
        let begin = Instant::now();
        let readings = read(
            begin,
            &[
                (0.0, 10.0),
                (2.0, 11.0),
                (4.0, 13.0),
                (60.0, 13.0),
                (61.0, 14.0),
                (62.0, 0.0),
                (63.0, 1e300),
                (64.0, f64::INFINITY),
                (65.0, 2.0),
                (66.0, 4.0),
                (67.0, 6.0),
            ],
        );
        let total = readings.total;
        assert_eq!((total.simulated, total.real, total.slow), (8.0, 7.0, 2.0));
        assert_eq!(readings.factor(begin + Duration::from_secs(67)), Some(2.0));
    }

    #[test]
    fn the_factor_is_that_of_the_last_five_seconds() {
        let begin = Instant::now();
        let at = |seconds| begin + Duration::from_secs_f64(seconds);
        let mut times: Vec<(f64, f64)> = (0_u32..60)
            .map(|second| (f64::from(second), f64::from(second)))
            .collect();
        assert_eq!(read(begin, &times[..2]).factor(at(1.0)), None, "one second says little");
        assert_eq!(read(begin, &times).factor(at(59.0)), Some(1.0));
        times.extend((1_u32..=5).map(|second| (59.0 + f64::from(second), 59.0 + 0.5 * f64::from(second))));
        assert_eq!(read(begin, &times).factor(at(64.0)), Some(0.5));
        assert_eq!(read(begin, &times).factor(at(70.0)), None, "nobody looks");
    }

    #[test]
    fn while_it_is_paused_nothing_is_read() {
        const STREAM: StreamId = StreamId(1);
        let time = SimulatedTime::default();
        let update = b"application/json:{\"time\":20}";
        let count = || time.0.lock().recent.len();
        time.read(STREAM, update);
        assert_eq!(count(), 0);
        time.set_running(true);
        time.read(STREAM, update);
        time.read(STREAM, update);
        assert_eq!(count(), 1, "once a second");
        time.interrupt(STREAM);
        assert_eq!(count(), 0);
        time.0.lock().next = None;
        time.read(STREAM, update);
        time.set_running(false);
        time.0.lock().next = None;
        time.read(STREAM, update);
        assert_eq!(count(), 0);
    }
}
