//! The id of a simulation, which names its log lines, its output and its line in `simulations.csv`.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use humantime::parse_rfc3339;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::shared::run::timestamp_in_milliseconds;

/// The time at which a simulation was requested, and its number since the server's start: `20261122T220517042-17`, to
/// the millisecond.
///
/// Ids are ordered by their numbers, regardless of the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SimulationId {
    number: u64,
    requested: Duration,
}

static NEXT: AtomicU64 = AtomicU64::new(1);

impl SimulationId {
    /// Returns a new id; unique on this server.
    pub fn next() -> Self {
        let requested = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
        Self {
            number: NEXT.fetch_add(1, Ordering::Relaxed),
            requested,
        }
    }

    /// Parses an id as another process of this server has written it.
    fn parse(text: &str) -> Option<Self> {
        let (time, number) = text.split_once('-')?;
        let mut spelled = String::new();
        for (index, letter) in time.chars().enumerate() {
            spelled.push_str(match index {
                4 | 6 => "-",
                11 | 13 => ":",
                15 => ".",
                _ => "",
            });
            spelled.push(letter);
        }
        spelled.push('Z');
        let requested = parse_rfc3339(&spelled)
            .ok()?
            .duration_since(SystemTime::UNIX_EPOCH)
            .ok()?;
        Some(Self {
            number: number.parse().ok()?,
            requested,
        })
    }

    /// Whether a text has only characters of an id, so that it is safe in a file name.
    pub fn is_like(text: &str) -> bool {
        text.chars()
            .all(|letter| letter.is_ascii_digit() || letter == 'T' || letter == '-')
    }
}

impl fmt::Display for SimulationId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let requested = timestamp_in_milliseconds(SystemTime::UNIX_EPOCH + self.requested);
        let requested: String = requested
            .chars()
            .filter(|letter| letter.is_ascii_digit() || *letter == 'T')
            .collect();
        write!(out, "{requested}-{}", self.number)
    }
}

impl Serialize for SimulationId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for SimulationId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::parse(&text).ok_or_else(|| D::Error::custom("this is no id of a simulation"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_tells_when_and_is_the_name_of_a_file() {
        let id = SimulationId {
            number: 17,
            requested: Duration::from_millis(1_795_385_117_042),
        };
        assert_eq!(id.to_string(), "20261122T220517042-17");
        assert!(SimulationId::is_like(&id.to_string()));
        assert_eq!(SimulationId::parse(&id.to_string()), Some(id));
        for other in ["", "-", "20261122T220517042", "2026-1", "20261122T220517042-x"] {
            assert_eq!(SimulationId::parse(other), None, "{other:?}");
        }
        assert!(SimulationId::next() < SimulationId::next());
        for other in ["..", "../x", "1/2", "20261122T220517-17.log", "1\0"] {
            assert!(!SimulationId::is_like(other), "{other:?}");
        }
    }
}
