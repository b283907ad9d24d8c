//! Why a probe of a simulation server failed. Pure.

use std::time::Duration;

/// Why a simulation server gave no usable answer.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProbeError {
    /// There was no connection, or it broke.
    #[error("no connection: {0}")]
    Connection(String),
    /// The answer was not complete in time.
    #[error("no answer within {} s", .0.as_secs_f64())]
    Timeout(Duration),
    /// The answer can't be used.
    #[error("an answer that makes no sense: {0}")]
    BadAnswer(String),
    /// It answers, and says that it can start no simulation.
    #[error("it can start no simulation: {0}")]
    NotReady(String),
}

impl ProbeError {
    /// Whether both are the same variant, whatever their details.
    pub fn is_same_kind(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}
