//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::shared::config::keys::keys;
use crate::shared::config::{seconds, seconds_or_zero};

keys! {
/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// Timeout of a checkout. Default: 120.
    #[serde(with = "seconds")]
    pub checkout: Duration = Duration::from_mins(2),
    /// Timeout of pulling and building an image. Default: 900.
    #[serde(with = "seconds")]
    pub build: Duration = Duration::from_mins(15),
    /// Timeout of Webots' start, until its world is ready: it downloads the world's assets and reads it. Default: 600.
    #[serde(with = "seconds")]
    pub launch: Duration = Duration::from_mins(10),
    /// Interval between two heartbeats of Webots. Default: 5.
    #[serde(with = "seconds")]
    pub heartbeat: Duration = Duration::from_secs(5),
    /// Time between SIGTERM and SIGKILL when Webots is ended. Default: 5.
    #[serde(with = "seconds")]
    pub grace: Duration = Duration::from_secs(5),
    /// Interval between two pings of a client. Default: 20.
    #[serde(with = "seconds")]
    pub ping: Duration = Duration::from_secs(20),
    /// A client that answers no ping for this long is disconnected. Must exceed `ping`. Default: 60.
    #[serde(with = "seconds")]
    pub silence: Duration = Duration::from_mins(1),
    /// Time for which a simulation waits for a disconnected client; 0: not at all. Default: 300.
    #[serde(with = "seconds_or_zero")]
    pub absence: Duration = Duration::from_mins(5),
    /// A simulation that has waited this long for its client gives its slot to another client that waits. Default: 60.
    #[serde(with = "seconds")]
    pub yield_after: Duration = Duration::from_mins(1),
    /// Time in which a viewer must open the stream of a simulation that is ready, else it ends; 0: it may take any time.
    /// Default: 60.
    #[serde(with = "seconds_or_zero")]
    pub arrival: Duration = Duration::from_mins(1),
    /// Time for which a slot is reserved for a client with a pass, whose turn it is in the line. Default: 10.
    #[serde(with = "seconds")]
    pub pass: Duration = Duration::from_secs(10),
    /// Interval between two questions to a remote whether branches of worlds that are kept ready have moved. Default: 60.
    #[serde(with = "seconds")]
    pub branches: Duration = Duration::from_mins(1),
    /// Timeout of simulations when the server stops. Default: 9.
    #[serde(with = "seconds")]
    pub stop: Duration = Duration::from_secs(9),
    /// Timeout of a simulation's answer to a request for one of its files, through the server. Default: 60.
    #[serde(with = "seconds")]
    pub answer: Duration = Duration::from_mins(1),
    /// Interval between two attempts to announce the server. Default: 5.
    #[serde(with = "seconds")]
    pub announce: Duration = Duration::from_secs(5),
}
}
