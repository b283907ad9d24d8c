//! The time of day, as text and as a number.

use std::time::SystemTime;

use humantime::{Rfc3339Timestamp, format_rfc3339_millis, format_rfc3339_seconds};

/// The end of the year 9999, in seconds since 1970.
const END: u64 = 253_402_300_800;

/// Formats a time as RFC 3339 in UTC, to the second. Empty for a time before 1970 or after 9999.
pub fn timestamp(time: SystemTime) -> String {
    text(time, format_rfc3339_seconds)
}

/// Formats a time as RFC 3339 in UTC, to the millisecond. Empty for a time before 1970 or after 9999.
pub fn timestamp_in_milliseconds(time: SystemTime) -> String {
    text(time, format_rfc3339_millis)
}

/// Serializes a time as RFC 3339 in UTC, to the second.
///
/// # Errors
/// When the output fails.
pub fn serialize_timestamp<S: serde::Serializer>(time: &SystemTime, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&timestamp(*time))
}

/// Returns the current time in seconds since 1970-01-01 UTC.
pub fn seconds_since_1970() -> u64 {
    SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs())
}

fn text(time: SystemTime, format: fn(SystemTime) -> Rfc3339Timestamp) -> String {
    // humantime panics outside of these.
    let has_text = time.duration_since(SystemTime::UNIX_EPOCH).is_ok_and(|since| since.as_secs() < END);
    if has_text { format(time).to_string() } else { String::new() }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn times_out_of_the_calendar_are_nothing() {
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 50)), "");
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH - Duration::from_secs(1)), "");
        let end = SystemTime::UNIX_EPOCH + Duration::from_secs(END);
        assert_eq!(timestamp(end), "");
        assert_eq!(timestamp_in_milliseconds(end - Duration::from_nanos(1)), "9999-12-31T23:59:59.999Z");
    }
}
