//! The time of day, as text and as a number.

use std::time::SystemTime;

use humantime::{format_rfc3339_millis, format_rfc3339_seconds};

/// Formats a time as RFC 3339 in UTC, to the second.
pub fn timestamp(time: SystemTime) -> String {
    format_rfc3339_seconds(time).to_string()
}

/// Formats a time as RFC 3339 in UTC, to the millisecond.
pub fn timestamp_in_milliseconds(time: SystemTime) -> String {
    format_rfc3339_millis(time).to_string()
}

/// Returns the current time in milliseconds since 1970-01-01 UTC.
pub fn milliseconds_since_1970() -> u64 {
    let age = SystemTime::UNIX_EPOCH.elapsed();
    age.map_or(0, |age| u64::try_from(age.as_millis()).unwrap_or(u64::MAX))
}

/// Returns the current time in seconds since 1970-01-01 UTC.
pub fn seconds_since_1970() -> u64 {
    SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs())
}
