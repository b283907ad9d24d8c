//! Why nothing usable came from a simulation server. Pure.

use std::fmt;
use std::time::Duration;

/// Why a simulation server gave no usable answer.
#[derive(Debug, Clone, PartialEq)]
pub enum Unreachable {
    /// No connection, or one that broke.
    Refused(String),
    /// No whole answer in time.
    TimedOut(Duration),
    /// An answer that makes no sense.
    BadAnswer(String),
    /// It answers, and says that it can start no simulation.
    NotReady(String),
}

impl Unreachable {
    /// Whether both are of one kind, whatever their words.
    #[must_use]
    pub fn is_like(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

impl fmt::Display for Unreachable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(why) => write!(out, "no connection: {why}"),
            Self::TimedOut(limit) => write!(out, "no answer within {} s", limit.as_secs_f64()),
            Self::NotReady(why) => write!(out, "it can start no simulation: {why}"),
            Self::BadAnswer(what) => write!(out, "an answer that makes no sense: {what}"),
        }
    }
}
