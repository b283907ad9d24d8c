//! Times of day in pages and logs: RFC 3339, in UTC, to the second.

use std::time::SystemTime;

/// A time in words that people and programs can read; empty for a time that no calendar has.
#[must_use]
pub fn timestamp(time: SystemTime) -> String {
    jiff::Timestamp::try_from(time).map(|time| format!("{time:.0}")).unwrap_or_default()
}

/// The time of day as programs count it.
#[must_use]
pub fn seconds_since_1970() -> u64 {
    SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs())
}
