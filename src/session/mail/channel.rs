//! The channels on which notices go: by mail, and to a messenger.

use std::time::Duration;

use tokio::time::timeout;

use super::notice_text::{signature, test_text};
use super::smtp::SmtpRelay;
use super::webhook::Webhook;
use crate::session::config::SessionConfig;
use crate::shared::text::one_line;

/// A channel for notices. Each has its own retries: one that does not work holds up no other.
#[derive(Clone)]
pub struct Channel {
    /// Its name in the log.
    pub(super) name: &'static str,
    /// `HOST:PORT` of the server that takes the texts.
    pub(super) server: String,
    transport: Transport,
    time_limit: Duration,
}

#[derive(Clone)]
enum Transport {
    Smtp(Box<SmtpRelay>),
    Webhook(Webhook),
}

impl Channel {
    /// To the administrator's mail address.
    ///
    /// # Errors
    /// When a key without which no mail is sent is not set.
    pub fn mail(config: &SessionConfig) -> Result<Self, String> {
        let relay = SmtpRelay::new(config).map_err(|key| format!("notifications are off: {key} is not set"))?;
        let (server, transport) = (relay.server(), Transport::Smtp(Box::new(relay)));
        Ok(Self { name: "mail", server, transport, time_limit: config.timing.mail_answer })
    }

    /// To the URL of the key `webhook`, if it is set.
    pub fn webhook(config: &SessionConfig) -> Option<Self> {
        let webhook = config.webhook.clone().map(Webhook)?;
        let (server, transport) = (webhook.server(), Transport::Webhook(webhook));
        Some(Self { name: "webhook", server, transport, time_limit: config.timing.mail_answer })
    }

    /// Delivers a text within `timing.mailAnswer`. Returns the server's answer.
    ///
    /// # Errors
    /// Why it is not taken, in one line.
    pub(super) async fn deliver(&self, text: &str) -> Result<String, String> {
        let delivered = timeout(self.time_limit, async {
            match &self.transport {
                Transport::Smtp(relay) => relay.deliver(text).await,
                Transport::Webhook(webhook) => webhook.deliver(text).await,
            }
        });
        let timed_out = |_| Err(format!("no answer within {} s", self.time_limit.as_secs_f64()));
        let problem = |problem: String| format!("{}: {}", self.server, one_line(&problem));
        delivered.await.unwrap_or_else(timed_out).map(|answer| one_line(&answer)).map_err(problem)
    }

    /// Sends a test now. Returns what was answered.
    ///
    /// # Errors
    /// Why it was not taken.
    pub async fn test(&self, config: &SessionConfig) -> Result<String, String> {
        let answer = self.deliver(&test_text(&signature(config))).await?;
        Ok(format!("{} took a test: {answer}", self.server))
    }
}
