//! Ejects a server whose starts fail for reasons of its own: for a while, it is chosen last.
//!
//! The rule is that of Envoy's outlier detection (`consecutive_5xx` with panic routing): once a server reports
//! [`FAILURES`] failed starts in a row, it is ejected for [`EJECTION`], and again with each further one. A successful
//! start ends the ejection.
//!
//! An ejected server gets clients if no other has room: if all fail alike, for example because the Git host is down,
//! none of them is the cause.

use std::time::{Duration, Instant};

/// Number of failed starts in a row that ejects a server; below it, an unlucky client could eject one.
const FAILURES: u32 = 3;
/// Duration of an ejection.
const EJECTION: Duration = Duration::from_mins(2);

/// What is known of a server's failed starts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Ejection {
    /// Failed starts in a row, as last reported.
    failed: u32,
    /// When the ejection ends; `None` if the server is not ejected.
    pub(super) until: Option<Instant>,
}

impl Ejection {
    /// Records how many of the last starts have failed in a row.
    pub(super) fn report(&mut self, now: Instant, failed: u32) {
        if failed < FAILURES {
            self.until = None;
        } else if failed > self.failed {
            self.until = Some(now + EJECTION);
        }
        self.failed = failed;
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
    fn three_failures_in_a_row_eject_a_server() {
        assert_eq!(ejected(&[0, 1, 2]), None);
        assert_eq!(ejected(&[1, 2, 3]), Some(122));
        assert_eq!(ejected(&[3, 4, 4]), Some(121));
        assert_eq!(ejected(&[3, 3, 0]), None);
        assert_eq!(ejected(&[3, 0, 1, 2]), None);
    }
}
