//! The time of day, as text and as a number.

use std::time::{Duration, SystemTime};

use humantime::{Rfc3339Timestamp, format_rfc3339_millis, format_rfc3339_seconds};

/// The end of the year 9999, in seconds since 1970.
const END: u64 = 253_402_300_800;
/// The length of `+01:00`.
const OFFSET: usize = 6;

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

/// Reads a time as RFC 3339: `2026-12-31T12:00:00Z`, `2026-12-31T13:00:00+01:00`.
pub fn read_timestamp(text: &str) -> Option<SystemTime> {
    let (local, offset) = text.len().checked_sub(OFFSET).and_then(|at| text.split_at_checked(at)).unwrap_or((text, ""));
    let &[sign @ (b'+' | b'-'), h1 @ b'0'..=b'2', h2 @ b'0'..=b'9', b':', m1 @ b'0'..=b'5', m2 @ b'0'..=b'9'] =
        offset.as_bytes()
    else {
        return humantime::parse_rfc3339(text).ok();
    };
    let number = |tens: u8, ones: u8| u64::from(tens - b'0') * 10 + u64::from(ones - b'0');
    let (hours, minutes) = (number(h1, h2), number(m1, m2));
    // humantime takes a second Z.
    if hours > 23 || local.ends_with('Z') {
        return None;
    }
    let ahead = Duration::from_secs(3600 * hours + 60 * minutes);
    let time = humantime::parse_rfc3339(&format!("{local}Z")).ok()?;
    let time = if sign == b'+' { time.checked_sub(ahead) } else { time.checked_add(ahead) };
    time.filter(|time| !timestamp(*time).is_empty())
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
    use super::*;

    #[test]
    fn times_of_any_zone_are_read() {
        for text in [
            "2026-11-22T22:17:17Z",
            "2026-11-22T23:17:17+01:00",
            "2026-11-22T17:47:17-04:30",
            "2026-11-22T22:17:17+00:00",
        ] {
            assert_eq!(read_timestamp(text).map(timestamp).as_deref(), Some("2026-11-22T22:17:17Z"), "{text}");
        }
        for text in [
            "",
            "+01:00",
            "2026-11-22T22:17:17",
            "2026-11-22",
            "2026-11-22T22:17:17+1:00",
            "2026-11-22T22:17:17+01:60",
            "2026-11-22T22:17:17+0100",
            "2026-11-22T22:17:17Z+01:00",
            "2026-11-22T22:17:17+25:00",
            "9999-12-31T23:59:59-23:00",
        ] {
            assert_eq!(read_timestamp(text), None, "{text}");
        }
    }

    #[test]
    fn times_out_of_the_calendar_are_nothing() {
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 50)), "");
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH - Duration::from_secs(1)), "");
        let end = SystemTime::UNIX_EPOCH + Duration::from_secs(END);
        assert_eq!(timestamp(end), "");
        assert_eq!(timestamp_in_milliseconds(end - Duration::from_nanos(1)), "9999-12-31T23:59:59.999Z");
    }
}
