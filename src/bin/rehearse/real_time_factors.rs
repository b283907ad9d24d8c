//! The speed of simulated time, in two numbers. Pure.

use serde::Serialize;

use crate::visit::Visit;

/// The speed of simulated time; 1 is real time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct RealTimeFactors {
    /// The 5th percentile of the seconds.
    pub(crate) p5: f64,
    /// The median of the seconds.
    pub(crate) median: f64,
}

/// The paces of a simulation without its first second, in which it starts.
pub(crate) fn factors_of(visit: &Visit) -> impl Iterator<Item = f64> {
    visit.pace.iter().skip(1).map(|pace| pace.factor)
}

/// The factors of all these seconds; `None` if there are none.
pub(crate) fn factors(values: impl Iterator<Item = f64>) -> Option<RealTimeFactors> {
    let values = sorted(values);
    Some(RealTimeFactors {
        p5: quantile(&values, 0.05)?,
        median: quantile(&values, 0.5)?,
    })
}

/// Sorts from the lowest to the highest.
pub(crate) fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

/// The value that a share of the sorted ones does not exceed (nearest rank).
pub(crate) fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a rank"
    )]
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied()
}
