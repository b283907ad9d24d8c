//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::shared::config::seconds;

/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// Timeout of a probe of a simulation server. Default: 3.
    #[serde(with = "seconds")]
    pub answer: Duration,
    /// Interval between two pings of a client. Default: 20.
    #[serde(with = "seconds")]
    pub ping: Duration,
    /// A client that answers no ping for this long is disconnected. Must exceed `ping`. Default: 60.
    #[serde(with = "seconds")]
    pub silence: Duration,
    /// Time after which a client that was sent to a simulation server and never arrived is given up. Default: 15.
    #[serde(with = "seconds")]
    pub placement: Duration,
    /// Time for which notices are collected before they are sent in one mail. Default: 10.
    #[serde(with = "seconds")]
    pub gather: Duration,
    /// Shortest interval between two mails about whether the same simulation server responds, and between two about its
    /// load. Default: 600.
    #[serde(with = "seconds")]
    pub flapping: Duration,
    /// Delay before a failed mail is retried. It doubles with each failure. Default: 10.
    #[serde(with = "seconds")]
    pub mail_retry: Duration,
    /// Time after which a failing mail is given up. Default: 3600.
    #[serde(with = "seconds")]
    pub mail_patience: Duration,
    /// Timeout of the delivery of one mail. Default: 30.
    #[serde(with = "seconds")]
    pub mail_answer: Duration,
    /// Timeout of open connections when the server stops, at most 4.5. Default: 4.
    #[serde(with = "seconds")]
    pub stop: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            answer: Duration::from_secs(3),
            ping: Duration::from_secs(20),
            silence: Duration::from_mins(1),
            placement: Duration::from_secs(15),
            gather: Duration::from_secs(10),
            flapping: Duration::from_mins(10),
            mail_retry: Duration::from_secs(10),
            mail_patience: Duration::from_hours(1),
            mail_answer: Duration::from_secs(30),
            stop: Duration::from_secs(4),
        }
    }
}
