//! The time of day, as text and as a number.

use std::time::SystemTime;

/// Formats a time as RFC 3339 in UTC, to the second. Empty for a time out of the calendar's range.
pub fn timestamp(time: SystemTime) -> String {
    jiff::Timestamp::try_from(time).map(|time| format!("{time:.0}")).unwrap_or_default()
}

/// Returns the current time in seconds since 1970-01-01 UTC.
pub fn seconds_since_1970() -> u64 {
    SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs())
}
