//! The outcome of each request to start a simulation, counted for `/metrics`.

use prometheus::IntCounterVec;

use crate::shared::http::Metrics;
use crate::simulation::ends::EndReason;

/// The outcome of a request to start a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The rules do not allow this world, its URL is wrong, or its address requests too often.
    Refused,
    /// All slots and the queue are full, or the address has reached its limit.
    Full,
    /// The world could not be checked out.
    NoCheckout,
    /// Webots did not become ready.
    NoWebots,
    /// The client left before Webots was ready.
    Left,
    /// The server was stopped before Webots was ready.
    Stopped,
    /// Webots was ready.
    Ready,
}

const ALL: [Outcome; 7] = [
    Outcome::Refused,
    Outcome::Full,
    Outcome::NoCheckout,
    Outcome::NoWebots,
    Outcome::Left,
    Outcome::Stopped,
    Outcome::Ready,
];

impl Outcome {
    /// The end of a simulation whose start has this outcome.
    pub fn end(self) -> EndReason {
        match self {
            Self::NoCheckout => EndReason::NoCheckout,
            Self::NoWebots => EndReason::NoWebots,
            Self::Stopped => EndReason::Stopped,
            Self::Refused | Self::Full | Self::Left | Self::Ready => EndReason::Left,
        }
    }

    fn label(self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::Full => "full",
            Self::NoCheckout => "no_checkout",
            Self::NoWebots => "no_webots",
            Self::Left => "left",
            Self::Stopped => "stopped",
            Self::Ready => "ready",
        }
    }
}

/// Creates the counter `webots_simulation_starts_total`, with a zero for each outcome.
///
/// # Errors
/// When a counter of this name exists.
pub fn counter(metrics: &Metrics) -> Result<IntCounterVec, prometheus::Error> {
    let counter = metrics.counter("webots_simulation_starts_total", "Simulations that were asked for", "outcome")?;
    for outcome in ALL {
        counter.with_label_values(&[outcome.label()]);
    }
    Ok(counter)
}

/// A start whose outcome is not known yet, or no start at all. Dropping a start counts it as `Left`.
#[derive(Debug, Default)]
pub struct Pending(Option<IntCounterVec>);

impl Pending {
    /// A start that was just requested.
    pub fn new(counter: &IntCounterVec) -> Self {
        Self(Some(counter.clone()))
    }

    /// Whether the outcome is not known yet.
    pub fn is_open(&self) -> bool {
        self.0.is_some()
    }

    /// Counts the outcome. Only the first one counts.
    pub fn resolve(&mut self, outcome: Outcome) {
        if let Some(counter) = self.0.take() {
            counter.with_label_values(&[outcome.label()]).inc();
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        self.resolve(Outcome::Left);
    }
}
