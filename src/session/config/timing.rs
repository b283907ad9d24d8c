//! The key `timing`: durations that are rarely changed.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::shared::config::seconds;

/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// How long a simulation server may take to answer. Default: 3.
    #[serde(with = "seconds")]
    pub answer: Duration,
    /// Between two pings of a client. Default: 20.
    #[serde(with = "seconds")]
    pub ping: Duration,
    /// A client that has answered no ping for so long is disconnected. Default: 60.
    #[serde(with = "seconds")]
    pub silence: Duration,
    /// How long a client that was sent to a simulation server is counted there if it never arrives. Default: 15.
    #[serde(with = "seconds")]
    pub placement: Duration,
    /// How long notices are collected before they are sent in one mail. Default: 10.
    #[serde(with = "seconds")]
    pub gather: Duration,
    /// Least time between two mails about the same simulation server. Default: 600.
    #[serde(with = "seconds")]
    pub flapping: Duration,
    /// How long to wait before a mail that failed is sent again. The wait doubles each time. Default: 10.
    #[serde(with = "seconds")]
    pub mail_retry: Duration,
    /// How long a mail that fails is tried. Default: 3600.
    #[serde(with = "seconds")]
    pub mail_patience: Duration,
    /// How long an SMTP server may take for one mail. Default: 30.
    #[serde(with = "seconds")]
    pub mail_answer: Duration,
    /// How long open connections may take to end when the server stops, at most 4.5. Default: 4.
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
