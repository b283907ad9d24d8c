//! How fast a simulation runs: its time against real time, as the stream of its Webots tells it.
//!
//! Streams are not parsed. Webots' updates begin with their time, so once a second the last update of what has just been
//! copied is looked for.

use std::sync::Arc;
use std::time::{Duration, Instant};

use memchr::memmem;
use parking_lot::Mutex;

/// The time of a simulation. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct SimulatedTime(Arc<Mutex<Readings>>);

#[derive(Debug, Default)]
struct Readings {
    last: Option<Reading>,
    /// The factor between the last two readings.
    recent: Option<f64>,
    /// The time that was simulated while somebody looked, and how long that took, in seconds.
    total: (f64, f64),
}

/// A time that was read.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: Instant,
    /// In seconds.
    simulated: f64,
}

/// The beginning of an update.
const UPDATE: &[u8] = b"application/json:{\"time\":";
/// Interval between two readings.
const INTERVAL: Duration = Duration::from_secs(1);
/// Between readings that are further apart nobody has looked, or the simulation was paused.
const GAP: Duration = Duration::from_secs(10);

impl SimulatedTime {
    /// Looks for a time in a part of the stream, unless one was read just now.
    pub fn read(&self, part: &[u8]) {
        let mut readings = self.0.lock();
        let is_due = readings.last.is_none_or(|last| last.at.elapsed() >= INTERVAL);
        if is_due && let Some(milliseconds) = last_time(part) {
            readings.add(Reading {
                at: Instant::now(),
                simulated: milliseconds / 1000.0,
            });
        }
    }

    /// Simulated seconds per second, of the last seconds; `None` if it was not read lately.
    pub fn recent(&self) -> Option<f64> {
        let readings = self.0.lock();
        let is_known = readings.last.is_some_and(|last| last.at.elapsed() < GAP);
        readings.recent.filter(|_| is_known)
    }

    /// Simulated seconds per second while somebody looked and time passed; `None` if that was never.
    pub fn mean(&self) -> Option<f64> {
        let (simulated, real) = self.0.lock().total;
        (real > 0.0).then(|| simulated / real)
    }
}

impl Readings {
    fn add(&mut self, next: Reading) {
        if let Some(last) = self.last {
            let (simulated, real) = (next.simulated - last.simulated, next.at - last.at);
            // A reset sets the time back.
            if simulated >= 0.0 && real < GAP {
                self.total.0 += simulated;
                self.total.1 += real.as_secs_f64();
                self.recent = Some(simulated / real.as_secs_f64());
            } else {
                self.recent = None;
            }
        }
        self.last = Some(next);
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

    #[test]
    fn pauses_and_resets_do_not_count() {
        let begin = Instant::now();
        let mut readings = Readings::default();
        for (seconds, simulated) in [
            (0, 10.0),
            (2, 11.0),
            (4, 13.0),
            (60, 13.0),
            (61, 14.0),
            (62, 0.0),
            (63, 2.0),
        ] {
            readings.add(Reading {
                at: begin + Duration::from_secs(seconds),
                simulated,
            });
        }
        assert_eq!(readings.total, (6.0, 6.0));
        assert_eq!(readings.recent, Some(2.0));
    }
}
