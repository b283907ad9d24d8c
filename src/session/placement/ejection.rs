//! Ejects a server whose starts fail for reasons of its own: for a while it is chosen last, then it is tried by one
//! client at a time.
//!
//! The rule is that of Envoy's outlier detection (`consecutive_5xx` with panic routing), and the end that of a circuit
//! breaker: once a server reports [`FAILURES`] failed starts in a row, it is ejected for [`EJECTION`], and again with
//! each further one. After that time it is half-open: one client at a time is sent there as to any other server. A
//! successful start ends the ejection.
//!
//! An ejected server gets clients if no other has room: if all fail alike, for example because the Git host is down,
//! none of them is the cause.

use std::time::{Duration, Instant};

/// Number of failed starts in a row that ejects a server; below it, an unlucky client could eject one.
const FAILURES: u32 = 3;
/// Duration of an ejection.
const EJECTION: Duration = Duration::from_mins(2);

/// Whether a server is ejected, by its failed starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Ejection {
    /// Its starts succeed, or too few have failed.
    #[default]
    Closed,
    /// It is chosen last.
    Open {
        /// Failed starts in a row, as last reported.
        failed: u32,
        /// When it becomes half-open.
        until: Instant,
    },
    /// It is tried by one client at a time.
    HalfOpen {
        /// Failed starts in a row, as last reported.
        failed: u32,
    },
}

impl Ejection {
    /// Records how many of the last starts have failed in a row.
    pub(super) fn report(&mut self, now: Instant, failed: u32) {
        let before = match self {
            Self::Closed => 0,
            Self::Open { failed, .. } | Self::HalfOpen { failed } => *failed,
        };
        if failed < FAILURES {
            *self = Self::Closed;
        } else if failed > before {
            let until = now + EJECTION;
            *self = Self::Open { failed, until };
        }
    }

    /// Makes a server half-open once its time has passed.
    pub(super) fn expire(&mut self, now: Instant) {
        if let Self::Open { failed, until } = *self
            && until <= now
        {
            *self = Self::HalfOpen { failed };
        }
    }

    /// Whether others are preferred. `is_tried`: a client that was sent to the server has not started there yet.
    pub(super) fn comes_last(self, is_tried: bool) -> bool {
        match self {
            Self::Closed => false,
            Self::Open { .. } => true,
            Self::HalfOpen { .. } => is_tried,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The second at which the server becomes half-open, after these reports of failed starts, one per second.
    fn open_until(reports: &[u32]) -> Option<u64> {
        let begin = Instant::now();
        let mut ejection = Ejection::default();
        for (second, failed) in (0..).zip(reports) {
            ejection.report(begin + Duration::from_secs(second), *failed);
        }
        match ejection {
            Ejection::Open { until, .. } => Some((until - begin).as_secs()),
            _ => None,
        }
    }

    #[test]
    fn three_failures_in_a_row_eject_a_server() {
        assert_eq!(open_until(&[0, 1, 2]), None);
        assert_eq!(open_until(&[1, 2, 3]), Some(122));
        assert_eq!(open_until(&[3, 4, 4]), Some(121));
        assert_eq!(open_until(&[3, 3, 0]), None);
        assert_eq!(open_until(&[3, 0, 1, 2]), None);
    }

    #[test]
    fn an_ejected_server_is_tried_until_a_start_succeeds() {
        let begin = Instant::now();
        let mut ejection = Ejection::default();
        ejection.report(begin, 3);
        let after = begin + EJECTION;
        ejection.expire(after);
        assert!(!ejection.comes_last(false) && ejection.comes_last(true));
        ejection.report(after, 3);
        assert_eq!(ejection, Ejection::HalfOpen { failed: 3 }, "no start has ended");
        ejection.report(after, 4);
        assert!(ejection.comes_last(false), "the trial has failed");
        ejection.expire(after + EJECTION);
        ejection.report(after + EJECTION, 0);
        assert_eq!(ejection, Ejection::Closed);
    }
}
