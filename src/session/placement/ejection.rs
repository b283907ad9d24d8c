//! Ejects a server whose starts fail for reasons of its own: it comes last for a time that doubles.
//!
//! The rule is that of Envoy's outlier detection (`consecutive_5xx` with an ejection time that grows, and panic routing),
//! with the half-open state of a circuit breaker:
//!
//! 1. The server is ejected for [`FIRST_EJECTION`] once it reports [`FAILURES`] failed starts in a row.
//! 2. After that time one client is sent there. Until its start succeeds, the server is ejected again.
//! 3. If it fails, the time doubles, up to [`MAX_EJECTION`]. If it succeeds, all of this is reset.
//!
//! An ejected server gets clients if no other has room: if all fail alike, as without a Git host, none of them is the
//! cause.

use std::time::{Duration, Instant};

/// Number of failed starts in a row that ejects a server; below it, an unlucky client could eject one.
const FAILURES: u32 = 3;
/// Duration of the first ejection.
const FIRST_EJECTION: Duration = Duration::from_secs(30);
/// Longest duration of an ejection.
const MAX_EJECTION: Duration = Duration::from_mins(5);

/// What is known of a server's failed starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Ejection {
    /// Failed starts in a row, as last reported.
    failed: u32,
    /// Number of ejections since the last successful start, trials excluded.
    times: u32,
    /// When the ejection ends; `None` if the server is not ejected.
    pub(super) until: Option<Instant>,
    /// Whether a client was sent there after an ejection, and the outcome of its start is not known yet.
    is_on_trial: bool,
}

impl Ejection {
    /// Records how many of the last starts have failed in a row.
    pub(super) fn report(&mut self, now: Instant, failed: u32) {
        if failed == 0 {
            *self = Self::default();
            return;
        }
        let has_failed_again = failed > self.failed;
        self.failed = failed;
        if failed >= FAILURES && has_failed_again && (self.until.is_none() || self.is_on_trial) {
            self.times = self.times.saturating_add(1);
            self.eject(now);
            self.is_on_trial = false;
        }
    }

    /// Records that a client was sent to the server.
    pub(super) fn note_pick(&mut self, now: Instant) {
        if self.times > 0 && self.until.is_none() {
            self.eject(now);
            self.is_on_trial = true;
        }
    }

    fn eject(&mut self, now: Instant) {
        let time = FIRST_EJECTION.saturating_mul(1 << (self.times - 1).min(8)).min(MAX_EJECTION);
        self.until = now.checked_add(time);
    }

    /// Ends an ejection whose time has passed.
    pub(super) fn expire(&mut self, now: Instant) {
        self.until.take_if(|until| *until <= now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The second at which the ejection ends, after these reports of failed starts, one per second.
    fn ejected(reports: &[u32]) -> Option<u64> {
        let (begin, mut ejection) = (Instant::now(), Ejection::default());
        for (second, failed) in (0..).zip(reports) {
            ejection.report(begin + Duration::from_secs(second), *failed);
        }
        ejection.until.map(|until| (until - begin).as_secs())
    }

    #[test]
    fn three_failures_in_a_row_eject_a_server_and_a_success_ends_that() {
        assert_eq!(ejected(&[0, 1, 2]), None);
        assert_eq!(ejected(&[1, 2, 3]), Some(32));
        assert_eq!(ejected(&[3, 4, 9]), Some(30), "clients that were on their way don't make it longer");
        assert_eq!(ejected(&[3, 3, 0]), None);
        assert_eq!(ejected(&[3, 0, 1, 2]), None);
    }

    #[test]
    fn one_client_tries_the_server_and_each_failure_doubles_the_time() {
        let begin = Instant::now();
        let (mut now, mut ejection, mut times) = (begin, Ejection::default(), Vec::new());
        ejection.report(now, 3);
        for failed in 4..10 {
            let until = ejection.until.unwrap();
            times.push((until - now).as_secs());
            now = until;
            ejection.expire(now);
            assert_eq!(ejection.until, None, "a client may try");
            ejection.note_pick(now);
            assert!(ejection.until.is_some(), "one is enough");
            ejection.report(now, failed);
        }
        assert_eq!(times, [30, 60, 120, 240, 300, 300]);
        ejection.report(now, 0);
        assert_eq!(ejection, Ejection::default());
    }

    #[test]
    fn a_trial_that_tells_nothing_is_repeated_as_late() {
        let mut now = Instant::now();
        let mut ejection = Ejection::default();
        ejection.report(now, 3);
        for _ in 0..5 {
            now += Duration::from_secs(30);
            ejection.expire(now);
            ejection.note_pick(now);
            ejection.report(now, 3);
            assert_eq!(ejection.until, Some(now + Duration::from_secs(30)));
        }
    }
}
