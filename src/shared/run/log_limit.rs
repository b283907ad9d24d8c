//! Keeps lines that anybody can cause from washing all others out of the log.

use std::collections::HashMap;
use std::num::NonZeroU32;
use std::sync::{Mutex, PoisonError};

use governor::clock::DefaultClock;
use governor::state::keyed::HashMapStateStore;
use governor::{Quota, RateLimiter};
use log::{Level, Log, Metadata, Record};

/// How many lines of a kind are written at once: the starts of a large class several times over.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(999);
/// How many of them in each minute after that: more than a busy server writes, and so few that somebody who causes them
/// without end needs hours to fill all files.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(119);

/// Lines are of a kind when the same place of the source writes them.
type Kind = (Option<&'static str>, Option<u32>);

/// A log that leaves lines out where there are too many of a kind, and says how many. Errors are always written.
pub struct LimitedLog<L> {
    inner: L,
    limit: RateLimiter<Kind, HashMapStateStore<Kind>, DefaultClock>,
    left_out: Mutex<HashMap<Kind, u64>>,
}

impl<L: Log> LimitedLog<L> {
    /// Writes to this log.
    #[must_use]
    pub fn new(inner: L) -> Self {
        let limit = RateLimiter::hashmap(Quota::per_minute(PER_MINUTE).allow_burst(BURST));
        Self { inner, limit, left_out: Mutex::default() }
    }
}

impl<L: Log> Log for LimitedLog<L> {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.inner.enabled(metadata)
    }

    fn log(&self, record: &Record<'_>) {
        if !self.inner.enabled(record.metadata()) {
            return;
        }
        let kind = (record.file_static(), record.line());
        let mut left_out = self.left_out.lock().unwrap_or_else(PoisonError::into_inner);
        if record.level() != Level::Error && self.limit.check_key(&kind).is_err() {
            *left_out.entry(kind).or_default() += 1;
            return;
        }
        let count = left_out.remove(&kind);
        drop(left_out);
        let Some(count) = count else {
            return self.inner.log(record);
        };
        let args = format_args!("{} ({count} more like this were left out)", record.args());
        let metadata = record.metadata().clone();
        self.inner.log(&Record::builder().metadata(metadata).module_path(record.module_path()).args(args).build());
    }

    fn flush(&self) {
        self.inner.flush();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Lines(Mutex<Vec<String>>);

    impl Log for Lines {
        fn enabled(&self, metadata: &Metadata<'_>) -> bool {
            metadata.level() < Level::Debug
        }

        fn log(&self, record: &Record<'_>) {
            self.0.lock().unwrap().push(record.args().to_string());
        }

        fn flush(&self) {}
    }

    #[test]
    fn a_flood_of_one_kind_leaves_the_others() {
        let log = LimitedLog::new(Lines::default());
        let say = |level, line, text: &str| {
            let args = format_args!("{text}");
            log.log(&Record::builder().level(level).file_static(Some("a.rs")).line(Some(line)).args(args).build());
        };
        for _ in 0..9000 {
            say(Level::Warn, 1, "flood");
            say(Level::Debug, 2, "not written at all");
        }
        say(Level::Info, 3, "another");
        for _ in 0..9000 {
            say(Level::Error, 4, "an error");
        }
        let lines = log.inner.0.lock().unwrap();
        let count = |text| lines.iter().filter(|line| line.starts_with(text)).count();
        assert!((1000..1010).contains(&count("flood")), "{}", count("flood"));
        assert_eq!((count("another"), count("an error"), count("not")), (1, 9000, 0));
    }

    #[test]
    fn what_was_left_out_is_counted() {
        let log = LimitedLog::new(Lines::default());
        log.left_out.lock().unwrap().insert((Some("a.rs"), Some(1)), 7);
        for text in ["once more", "again"] {
            let args = format_args!("{text}");
            log.log(&Record::builder().level(Level::Info).file_static(Some("a.rs")).line(Some(1)).args(args).build());
        }
        assert_eq!(*log.inner.0.lock().unwrap(), ["once more (7 more like this were left out)", "again"]);
    }
}
