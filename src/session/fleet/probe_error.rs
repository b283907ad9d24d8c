//! Why a probe of a simulation server failed. Pure.

use std::time::Duration;

/// The reason, for the log and the pages.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProbeError {
    /// The connection failed or broke.
    #[error("no connection: {0}")]
    Connection(String),
    /// The answer was not complete within this time.
    #[error("no answer within {} s", .0.as_secs_f64())]
    Timeout(Duration),
    /// The answer is invalid.
    #[error("an answer that makes no sense: {0}")]
    BadAnswer(String),
    /// It answers that it can't start simulations.
    #[error("it can start no simulation: {0}")]
    NotReady(String),
}
