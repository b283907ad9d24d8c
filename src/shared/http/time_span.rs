//! The span of time of a request for records, and the answer, a CSV file.

use std::ops::RangeInclusive;
use std::time::{Duration, SystemTime};

use actix_web::HttpResponse;
use actix_web::http::header;
use serde::Deserialize;

use crate::shared::run::timestamp;

/// A span of time, `?from=SECONDS&to=SECONDS` since 1970; without an end it lasts, and without a beginning it is the day
/// before its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct TimeSpan {
    from: Option<u64>,
    to: Option<u64>,
}

/// The last second that is written with a year of four digits.
const LAST: u64 = 253_402_300_799;
const DAY: u64 = 24 * 3600;

impl TimeSpan {
    /// Its first and last moment as text, in UTC.
    pub fn in_utc(self) -> RangeInclusive<String> {
        let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default().as_secs();
        let to = self.to.unwrap_or(now).min(LAST);
        let from = self.from.unwrap_or(to.saturating_sub(DAY)).min(LAST);
        let text = |seconds| timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
        text(from)..=text(to)
    }

    /// The query of a URL that asks for it.
    pub fn query(self) -> String {
        let part = |name, value: Option<u64>| value.map(|seconds| format!("{name}={seconds}"));
        let parts = [part("from", self.from), part("to", self.to)];
        parts.into_iter().flatten().collect::<Vec<_>>().join("&")
    }
}

/// A file with these lines below a heading, each with its line end.
pub fn csv_file(heading: &str, lines: &[String]) -> HttpResponse {
    let length = heading.len() + lines.iter().map(String::len).sum::<usize>();
    let mut text = String::with_capacity(length);
    text.push_str(heading);
    text.extend(lines.iter().map(String::as_str));
    HttpResponse::Ok()
        .content_type("text/csv; charset=utf-8")
        .insert_header((header::CONTENT_DISPOSITION, "attachment; filename=\"simulations.csv\""))
        .body(text)
}
