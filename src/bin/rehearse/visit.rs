//! What one client has met, from its wish to its end.

use serde::Serialize;

use crate::behaviour::Behaviour;

/// What came of one client. Times are seconds; those of the day begin with the rehearsal.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Visit {
    /// Which client.
    pub(crate) client: u32,
    /// How it behaved.
    pub(crate) behaviour: Behaviour,
    /// When it asked.
    pub(crate) asked: f64,
    /// The simulation server that it was sent to, as `HOST:PORT` or `HOST/PORT`.
    pub(crate) server: Option<String>,
    /// What came of it.
    pub(crate) outcome: Outcome,
    /// How long each step took, as far as it came.
    pub(crate) steps: Steps,
    /// How fast simulated time passed, while the simulation ran.
    pub(crate) pace: Vec<Pace>,
    /// When it was gone.
    pub(crate) ended: f64,
}

/// What came of a client's wish.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase", tag = "outcome", content = "why")]
pub(crate) enum Outcome {
    /// Its simulation ran, until it left.
    Ran,
    /// Its simulation ran, and ended before it left.
    BrokeOff(String),
    /// Its simulation ran, and nobody looked on until the end: it slept, vanished, or the rehearsal was interrupted.
    Unseen,
    /// It was told why it gets none.
    Refused(String),
    /// It got none, and no reason.
    Failed(String),
    /// It left on purpose before its simulation ran.
    Left,
}

/// How long the steps to a running simulation took, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Steps {
    /// Until a simulation server had a place: availability, the session server's answer, the waiting line.
    pub(crate) waiting: Option<f64>,
    /// From then until Webots was started: the world's checkout.
    pub(crate) checkout: Option<f64>,
    /// From then until simulated time passed.
    pub(crate) launch: Option<f64>,
    /// All of it.
    pub(crate) until_running: Option<f64>,
}

/// How fast simulated time passed within about a second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct Pace {
    /// When: the end of that second.
    pub(crate) at: f64,
    /// Simulated by real time: 1 is real time.
    pub(crate) factor: f64,
}

impl Visit {
    /// Whether a simulation ran for this client.
    pub(crate) fn has_run(&self) -> bool {
        matches!(self.outcome, Outcome::Ran | Outcome::BrokeOff(_) | Outcome::Unseen)
    }
}
