//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::config::keys::keys;
use crate::shared::config::{Seconds, SecondsOrZero};

keys! {
/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// Timeout of a whole checkout, and of each of its git commands. Default: 120.
    #[serde(with = "Seconds")]
    pub checkout: Duration = Duration::from_mins(2),
    /// Timeout of pulling and building an image. Default: 900.
    #[serde(with = "Seconds")]
    pub build: Duration = Duration::from_mins(15),
    /// Timeout of Webots' start, until its world is ready: it downloads the world's assets and reads it. Default: 600.
    #[serde(with = "Seconds")]
    pub launch: Duration = Duration::from_mins(10),
    /// Interval between two heartbeats of Webots. Default: 5.
    #[serde(with = "Seconds")]
    pub heartbeat: Duration = Duration::from_secs(5),
    /// Time between SIGTERM and SIGKILL when Webots is ended. Default: 5.
    #[serde(with = "Seconds")]
    pub grace: Duration = Duration::from_secs(5),
    /// Interval between two pings of a client. Default: 20.
    #[serde(with = "Seconds")]
    pub ping: Duration = Duration::from_secs(20),
    /// A client that answers no ping for this long is disconnected. Must exceed `ping`. Default: 60.
    #[serde(with = "Seconds")]
    pub silence: Duration = Duration::from_mins(1),
    /// Time for which a simulation waits for a disconnected client; 0: not at all. Default: 300.
    #[serde(with = "SecondsOrZero")]
    pub absence: Duration = Duration::from_mins(5),
    /// A simulation that has waited this long for its client gives its slot to another client that waits. Default: 60.
    #[serde(with = "Seconds")]
    pub yield_after: Duration = Duration::from_mins(1),
    /// Time in which a viewer must open the stream of a simulation that is ready, else it ends; 0: it may take any time.
    /// Default: 60.
    #[serde(with = "SecondsOrZero")]
    pub arrival: Duration = Duration::from_mins(1),
    /// Time for which a slot is reserved for a client with a pass, whose turn it is in the line. Default: 10.
    #[serde(with = "Seconds")]
    pub pass: Duration = Duration::from_secs(10),
    /// Interval between two questions to a remote whether branches of worlds that are kept ready have moved. Default: 60.
    #[serde(with = "Seconds")]
    pub branches: Duration = Duration::from_mins(1),
    /// Timeout of simulations when the server stops. Default: 9.
    #[serde(with = "Seconds")]
    pub stop: Duration = Duration::from_secs(9),
    /// Timeout of a simulation's answer to a request for one of its files, through the server. Default: 60.
    #[serde(with = "Seconds")]
    pub answer: Duration = Duration::from_mins(1),
    /// Interval between two attempts to announce the server. Default: 5.
    #[serde(with = "Seconds")]
    pub announce: Duration = Duration::from_secs(5),
}
}
