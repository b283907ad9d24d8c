//! The record of one client, from its request to its end.

use serde::Serialize;

use crate::behaviour::Behaviour;

/// The visit of one client. Times are in seconds since the start of the rehearsal.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Visit {
    /// The number of the client.
    pub(crate) client: u32,
    /// Its behaviour.
    pub(crate) behaviour: Behaviour,
    /// When it requested a simulation.
    pub(crate) asked: f64,
    /// The simulation server that it was sent to, as `HOST:PORT` or `HOST/PORT`.
    pub(crate) server: Option<String>,
    /// The number of clients ahead when it entered the line, if it was told.
    pub(crate) place: Option<u32>,
    /// When it was its turn: a simulation server had a slot for it.
    pub(crate) turn: Option<f64>,
    /// Its outcome.
    pub(crate) outcome: Outcome,
    /// The duration of each step that it completed.
    pub(crate) steps: Steps,
    /// The speed of simulated time while the simulation ran.
    pub(crate) pace: Vec<Pace>,
    /// When it had left.
    pub(crate) ended: f64,
}

/// The outcome of a client's request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase", tag = "outcome", content = "why")]
pub(crate) enum Outcome {
    /// Its simulation ran, until it left.
    Ran,
    /// Its simulation ran, and ended before it left.
    BrokeOff(String),
    /// Its simulation ran, and its end was not observed: the client slept, vanished, or the rehearsal was interrupted.
    Unseen,
    /// It was refused, with this reason.
    Refused(String),
    /// It got none, for this reason, without a refusal.
    Failed(String),
    /// It left on purpose before its simulation ran.
    Left,
}

/// The durations of the steps to a running simulation, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Steps {
    /// Until a simulation server had a slot: availability, the session server's answer, the queue.
    pub(crate) waiting: Option<f64>,
    /// From then until Webots was started: the world's checkout.
    pub(crate) checkout: Option<f64>,
    /// From then until simulated time passed.
    pub(crate) launch: Option<f64>,
    /// The whole time.
    pub(crate) until_running: Option<f64>,
}

/// The speed of simulated time within about a second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct Pace {
    /// The end of that second.
    pub(crate) at: f64,
    /// Simulated time divided by real time: 1 is real time.
    pub(crate) factor: f64,
}

impl Visit {
    /// Whether a simulation ran for this client.
    pub(crate) fn has_run(&self) -> bool {
        matches!(self.outcome, Outcome::Ran | Outcome::BrokeOff(_) | Outcome::Unseen)
    }
}
