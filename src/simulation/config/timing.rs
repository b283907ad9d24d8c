//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::shared::config::{seconds, seconds_or_zero};

/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// How long a checkout may take. Default: 120.
    #[serde(with = "seconds")]
    pub checkout: Duration,
    /// How long an image may take to be pulled and built. Default: 900.
    #[serde(with = "seconds")]
    pub build: Duration,
    /// How long Webots may take until it listens on its port. Default: 120.
    #[serde(with = "seconds")]
    pub launch: Duration,
    /// Between two heartbeats of Webots. Default: 5.
    #[serde(with = "seconds")]
    pub heartbeat: Duration,
    /// How long Webots may take to end after SIGTERM, before SIGKILL. Default: 5.
    #[serde(with = "seconds")]
    pub grace: Duration,
    /// Between two pings of a client. Default: 20.
    #[serde(with = "seconds")]
    pub ping: Duration,
    /// A client that has answered no ping for so long is disconnected, and its simulation ends. Default: 60.
    #[serde(with = "seconds")]
    pub silence: Duration,
    /// How long a simulation waits for a client that may come back; 0: not at all. Default: 60.
    #[serde(with = "seconds_or_zero")]
    pub absence: Duration,
    /// How long open connections and simulations may take to end when the server stops. Default: 9.
    #[serde(with = "seconds")]
    pub stop: Duration,
    /// Between two tries to announce the server. Default: 5.
    #[serde(with = "seconds")]
    pub announce: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            checkout: Duration::from_mins(2),
            build: Duration::from_mins(15),
            launch: Duration::from_mins(2),
            heartbeat: Duration::from_secs(5),
            grace: Duration::from_secs(5),
            ping: Duration::from_secs(20),
            silence: Duration::from_mins(1),
            absence: Duration::from_mins(1),
            stop: Duration::from_secs(9),
            announce: Duration::from_secs(5),
        }
    }
}
