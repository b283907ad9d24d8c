//! Posts notices to a messenger: one JSON object with the field `text`, which Slack, Matrix' hookshot and Mattermost take.
//!
//! Anybody who knows the URL can post there, so it is a secret: no log and no error contains it.

use std::time::Duration;

use serde_json::json;

use crate::shared::config::Secret;
use crate::shared::http::tls;
use crate::shared::text::client_text;

/// The URL that notices are posted to.
#[derive(Clone)]
pub(super) struct Webhook(pub(super) Secret);

impl Webhook {
    /// `HOST:PORT`.
    pub(super) fn server(&self) -> String {
        let url = url::Url::parse(self.0.reveal()).ok();
        let host = url.as_ref().and_then(|url| Some(format!("{}:{}", url.host_str()?, url.port_or_known_default()?)));
        host.unwrap_or_default()
    }

    /// Posts a text. Returns the status of the answer.
    ///
    /// # Errors
    /// When it is not taken.
    pub(super) async fn deliver(&self, text: &str) -> Result<String, String> {
        // Messengers take what is in angle brackets for links and calls.
        let text: Vec<String> = text.lines().map(client_text).collect();
        // The delivery as a whole has a timeout; awc has one of its own for connections that is shorter.
        let mut connector = awc::Connector::new().timeout(Duration::from_hours(24));
        if let Some(config) = tls::client_config() {
            connector = connector.rustls_0_23(config);
        }
        // A redirect would send the notices to another server.
        let client = awc::Client::builder().connector(connector).disable_timeout().disable_redirects().finish();
        let answer = client.post(self.0.reveal()).send_json(&json!({ "text": text.join("\n") })).await;
        let status = answer.map_err(|error| tls::reason(&error).unwrap_or_else(|| error.to_string()))?.status();
        if status.is_success() { Ok(status.to_string()) } else { Err(status.to_string()) }
    }
}
