//! The channels for notices: mail, and the webhook of a messenger.
//!
//! A messenger takes one JSON object with the field `text`, as Slack, Matrix' hookshot and Mattermost do. Anybody who
//! knows the URL can post there, so the URL is a secret: no log and no error contains it.

use std::time::Duration;

use serde_json::json;
use tokio::time::timeout;

use super::notice_text::{signature, test_text};
use super::smtp::SmtpRelay;
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::http::tls;
use crate::shared::text::{client_text, one_line};

/// A channel for notices. Each has its own retries: one that fails does not delay the other.
pub struct Channel {
    /// Its name in the log.
    pub(super) name: &'static str,
    /// `HOST:PORT` of the server that takes the texts.
    pub(super) server: String,
    transport: Transport,
    time_limit: Duration,
}

enum Transport {
    Smtp(Box<SmtpRelay>),
    Webhook(Secret),
}

impl Channel {
    /// To the administrator's mail address.
    ///
    /// # Errors
    /// When a key that mail requires is not set.
    pub fn mail(config: &SessionConfig) -> Result<Self, String> {
        let relay = SmtpRelay::new(config).map_err(|key| format!("no mail is sent: {key} is not set"))?;
        Ok(Self {
            name: "mail",
            server: relay.server(),
            transport: Transport::Smtp(Box::new(relay)),
            time_limit: config.timing.mail_answer,
        })
    }

    /// To the URL of the key `webhook`, if it is set.
    pub fn webhook(config: &SessionConfig) -> Option<Self> {
        let webhook = config.webhook.clone()?;
        let url = url::Url::parse(webhook.reveal()).ok()?;
        let server = format!("{}:{}", url.host_str()?, url.port_or_known_default()?);
        Some(Self {
            name: "webhook",
            server,
            transport: Transport::Webhook(webhook),
            time_limit: config.timing.mail_answer,
        })
    }

    /// Delivers a text within `timing.mailAnswer`. Returns the server's answer.
    ///
    /// # Errors
    /// Why the server did not accept it, in one line.
    pub(super) async fn deliver(&self, text: &str) -> Result<String, String> {
        let delivered = timeout(self.time_limit, async {
            match &self.transport {
                Transport::Smtp(relay) => relay.deliver(text).await,
                Transport::Webhook(url) => post(url, text).await,
            }
        });
        let timed_out = |_| Err(format!("no answer within {} s", self.time_limit.as_secs_f64()));
        let problem = |problem: String| format!("{}: {}", self.server, one_line(&problem));
        delivered
            .await
            .unwrap_or_else(timed_out)
            .map(|answer| one_line(&answer))
            .map_err(problem)
    }

    /// Sends a test. Returns the server's answer, as text.
    ///
    /// # Errors
    /// Why the server did not accept it.
    pub async fn test(&self, config: &SessionConfig) -> Result<String, String> {
        let answer = self.deliver(&test_text(&signature(config))).await?;
        Ok(format!("{} took a test: {answer}", self.server))
    }
}

/// Posts a text to a messenger. Returns the status of the answer.
async fn post(url: &Secret, text: &str) -> Result<String, String> {
    // Messengers take text in angle brackets for links and mentions.
    let text: Vec<String> = text.lines().map(client_text).collect();
    // The delivery as a whole has a timeout; awc's own timeout for connecting is shorter.
    let mut connector = awc::Connector::new().timeout(Duration::from_hours(24));
    if let Some(config) = tls::client_config() {
        connector = connector.rustls_0_23(config);
    }
    // A redirect would send the notices to another server.
    let client = awc::Client::builder()
        .connector(connector)
        .disable_timeout()
        .disable_redirects()
        .finish();
    let answer = client
        .post(url.reveal())
        .send_json(&json!({ "text": text.join("\n") }))
        .await;
    let status = answer
        .map_err(|error| tls::reason(&error).unwrap_or_else(|| error.to_string()))?
        .status();
    if status.is_success() {
        Ok(status.to_string())
    } else {
        Err(status.to_string())
    }
}
