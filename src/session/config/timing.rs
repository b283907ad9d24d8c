//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::config::Seconds;
use crate::shared::config::keys::keys;

keys! {
/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// Timeout of a probe of a simulation server. Default: 3.
    #[serde(with = "Seconds")]
    pub answer: Duration = Duration::from_secs(3),
    /// Interval between two pings of a client. Default: 20.
    #[serde(with = "Seconds")]
    pub ping: Duration = Duration::from_secs(20),
    /// A client that answers no ping for this long is disconnected. Must exceed `ping`. Default: 60.
    #[serde(with = "Seconds")]
    pub silence: Duration = Duration::from_mins(1),
    /// Time after which a client that was sent to a simulation server and never arrived is given up. Default: 15.
    #[serde(with = "Seconds")]
    pub placement: Duration = Duration::from_secs(15),
    /// Time for which notices are collected before they are sent in one mail. Default: 10.
    #[serde(with = "Seconds")]
    pub gather: Duration = Duration::from_secs(10),
    /// Shortest interval between two mails about whether the same simulation server responds, and between two about its
    /// load. Default: 600.
    #[serde(with = "Seconds")]
    pub flapping: Duration = Duration::from_mins(10),
    /// Delay before a failed mail is retried. It doubles with each failure. Default: 10.
    #[serde(with = "Seconds")]
    pub mail_retry: Duration = Duration::from_secs(10),
    /// Time after which a failing mail is given up. Default: 3600.
    #[serde(with = "Seconds")]
    pub mail_patience: Duration = Duration::from_hours(1),
    /// Timeout of the delivery of one mail. Default: 30.
    #[serde(with = "Seconds")]
    pub mail_answer: Duration = Duration::from_secs(30),
}
}
