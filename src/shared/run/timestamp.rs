//! The time of day, as text and as a number.

use std::num::NonZeroU8;
use std::time::{Duration, SystemTime};

use time::OffsetDateTime;
use time::format_description::well_known::iso8601::{Config, EncodedConfig, TimePrecision};
use time::format_description::well_known::{Iso8601, Rfc3339};

const TO_THE_SECOND: EncodedConfig =
    Config::DEFAULT.set_time_precision(TimePrecision::Second { decimal_digits: None }).encode();
const TO_THE_MILLISECOND: EncodedConfig =
    Config::DEFAULT.set_time_precision(TimePrecision::Second { decimal_digits: NonZeroU8::new(3) }).encode();

/// Formats a time as RFC 3339 in UTC, to the second. Empty for a time out of the calendar's range.
pub fn timestamp(time: SystemTime) -> String {
    text::<TO_THE_SECOND>(time).unwrap_or_default()
}

/// Formats a time as RFC 3339 in UTC, to the millisecond. Empty for a time out of the calendar's range.
pub fn timestamp_in_milliseconds(time: SystemTime) -> String {
    text::<TO_THE_MILLISECOND>(time).unwrap_or_default()
}

/// Reads a time as RFC 3339: `2026-12-31T12:00:00Z`, or with an offset, `2026-12-31T13:00:00+01:00`.
pub fn read_timestamp(text: &str) -> Option<SystemTime> {
    let nanoseconds = OffsetDateTime::parse(text, &Rfc3339).ok()?.unix_timestamp_nanos();
    SystemTime::UNIX_EPOCH.checked_add(Duration::from_nanos(u64::try_from(nanoseconds).ok()?))
}

/// Returns the current time in seconds since 1970-01-01 UTC.
pub fn seconds_since_1970() -> u64 {
    SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs())
}

fn text<const CONFIG: EncodedConfig>(time: SystemTime) -> Option<String> {
    let since_1970 = time.duration_since(SystemTime::UNIX_EPOCH).ok()?;
    let nanoseconds = i128::try_from(since_1970.as_nanos()).ok()?;
    OffsetDateTime::from_unix_timestamp_nanos(nanoseconds).ok()?.format(&Iso8601::<CONFIG>).ok()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn times_are_written_as_rfc_3339_says() {
        let time = SystemTime::UNIX_EPOCH + Duration::from_millis(1_795_385_837_500);
        assert_eq!(timestamp(time), "2026-11-22T22:17:17Z");
        assert_eq!(timestamp_in_milliseconds(time), "2026-11-22T22:17:17.500Z");
    }

    #[test]
    fn times_out_of_the_calendar_are_nothing() {
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 50)), "");
        assert_eq!(timestamp(SystemTime::UNIX_EPOCH - Duration::from_secs(1)), "");
    }
}
