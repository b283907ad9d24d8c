//! How often slots of a server become free.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Length of one count.
const STEP: Duration = Duration::from_mins(1);
/// Number of counts that are kept: ten minutes.
const KEPT: usize = 10;
/// Fewest slots that must have become free.
const BASIS: u32 = 3;

/// The slots that became free in the last ten minutes.
#[derive(Debug, Clone)]
pub struct Rate {
    /// The counts, the newest last.
    counts: VecDeque<u32>,
    /// When the newest count began.
    begun: Instant,
    /// When the first one began.
    since: Instant,
}

impl Rate {
    /// Nothing was counted yet.
    pub fn new(now: Instant) -> Self {
        Self {
            counts: VecDeque::from([0]),
            begun: now,
            since: now,
        }
    }

    /// Counts slots that have become free.
    pub fn count(&mut self, now: Instant, slots: u32) {
        self.advance(now);
        if let Some(newest) = self.counts.back_mut() {
            *newest = newest.saturating_add(slots);
        }
    }

    /// The slots that became free, and the time in which they did.
    pub fn freed(&mut self, now: Instant) -> (u32, Duration) {
        self.advance(now);
        let freed = self.counts.iter().fold(0, |sum: u32, count| sum.saturating_add(*count));
        (freed, now.saturating_duration_since(self.since))
    }

    fn advance(&mut self, now: Instant) {
        let steps = now.saturating_duration_since(self.begun).as_secs() / STEP.as_secs();
        for _ in 0..steps.min(KEPT as u64) {
            self.counts.push_back(0);
        }
        self.begun += STEP * u32::try_from(steps).unwrap_or(u32::MAX);
        while self.counts.len() > KEPT {
            self.counts.pop_front();
        }
        let before = STEP * u32::try_from(self.counts.len() - 1).unwrap_or_default();
        self.since = self
            .begun
            .checked_sub(before)
            .map_or(self.since, |oldest| self.since.max(oldest));
    }
}

/// How often slots of some servers become free.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Basis {
    freed: u32,
    per_second: f64,
}

impl Basis {
    /// That of servers with these rates.
    pub(super) fn of(rates: impl Iterator<Item = (u32, Duration)>) -> Self {
        let mut basis = Self::default();
        for (slots, time) in rates.filter(|(_, time)| !time.is_zero()) {
            basis.freed = basis.freed.saturating_add(slots);
            basis.per_second += f64::from(slots) / time.as_secs_f64();
        }
        basis
    }
}

/// Seconds until a client has a slot that has `ahead` clients ahead of it, coarsely rounded; `None` without a basis.
pub(super) fn estimate(basis: Basis, ahead: u32) -> Option<u32> {
    if basis.freed < BASIS {
        return None;
    }
    let seconds = (f64::from(ahead) + 1.0) / basis.per_second;
    let step = if seconds < 120.0 { 10.0 } else { 60.0 };
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a positive number of seconds; the conversion saturates"
    )]
    let rounded = ((seconds / step).ceil() * step) as u32;
    Some(rounded)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_last_ten_minutes_count() {
        let start = Instant::now();
        let mut rate = Rate::new(start);
        let at = |seconds| start + Duration::from_secs(seconds);
        for minute in 0..20 {
            rate.count(at(60 * minute + 5), 6);
        }
        let (freed, time) = rate.freed(at(60 * 19 + 30));
        assert_eq!((freed, time), (60, Duration::from_secs(570)));
        let (freed, _) = rate.freed(at(60 * 60));
        assert_eq!(freed, 0);
    }

    #[test]
    fn an_estimate_needs_a_basis() {
        let minute = Duration::from_mins(1);
        let estimate = |rates: &[(u32, Duration)], ahead| estimate(Basis::of(rates.iter().copied()), ahead);
        assert_eq!(estimate(&[(2, minute)], 0), None);
        assert_eq!(estimate(&[(9, Duration::ZERO)], 0), None);
        assert_eq!(estimate(&[(2, minute), (4, minute)], 4), Some(50));
        assert_eq!(estimate(&[(3, 10 * minute)], 1), Some(420));
        assert_eq!(estimate(&[(u32::MAX, minute), (1, minute)], u32::MAX), Some(60));
    }
}
