//! What a simulation server tells in `GET /status`, the one page that both servers know.

use serde::{Deserialize, Serialize};

use super::load::Load;
use super::repositories::UrlPrefix;

/// The part of a simulation server's `/status` that decides where clients go.
///
/// Only `load` is required: everything else has a default that means 'not said', so that an older or another
/// server's page is understood as far as it goes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Dispatch {
    /// Percent, the mean of the last five seconds.
    pub load: Load,
    /// The server's version.
    #[serde(default)]
    pub version: String,
    /// The simulations of the server, where it counts them.
    #[serde(default)]
    pub instances: Option<Instances>,
    /// Whose worlds the server runs at any load.
    #[serde(default)]
    pub allowed_repositories: Vec<UrlPrefix>,
    /// Whose worlds it never runs.
    #[serde(default)]
    pub blocked_repositories: Vec<UrlPrefix>,
    /// The highest load, in percent, at which worlds of others may run; 0: never.
    #[serde(default)]
    pub share_idle_time: f64,
    /// Whether the server can run worlds of others in containers.
    #[serde(default)]
    pub docker: Option<bool>,
    /// Whether the server takes no new clients because it is to end.
    #[serde(default)]
    pub draining: bool,
}

/// How many simulations a server has, by their state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Instances {
    /// Clients in the waiting line.
    pub queued: u32,
    /// Checking out or launching.
    pub starting: u32,
    /// Webots runs, its simulation is paused.
    pub idle: u32,
    /// Webots runs, and so does its simulation.
    pub running: u32,
    /// How many simulations fit.
    pub places: u32,
    /// Clients that asked for a start since the server began; it only grows.
    pub arrivals: u64,
}

impl Instances {
    /// Clients that hold a place or wait for one.
    #[must_use]
    pub fn present(&self) -> u32 {
        self.queued + self.starting + self.idle + self.running
    }
}
