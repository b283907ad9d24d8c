//! Posts notices to a messenger: one JSON object with the field `text`, which Slack, Matrix' hookshot and Mattermost take.
//!
//! Anybody who knows the URL can post there, so it is a secret: no log and no error contains it.

use std::time::Duration;

use awc::http::StatusCode;
use serde_json::json;

use super::smtp::MailError;
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::http::tls;
use crate::shared::text::client_text;

/// Where notices are posted to.
#[derive(Debug, Clone)]
pub(super) struct Webhook {
    url: Secret,
    /// `HOST:PORT`.
    server: String,
    time_limit: Duration,
}

impl Webhook {
    /// The webhook of the configuration.
    ///
    /// # Errors
    /// When there is none.
    pub(super) fn new(config: &SessionConfig) -> Result<Self, MailError> {
        let url = config.webhook.clone().ok_or(MailError::Off("webhook"))?;
        let parsed = url::Url::parse(url.reveal()).ok();
        let host = parsed.as_ref().and_then(|url| Some((url.host_str()?, url.port_or_known_default()?)));
        let server = host.map(|(host, port)| format!("{host}:{port}")).ok_or(MailError::Off("webhook"))?;
        Ok(Self { url, server, time_limit: config.timing.mail_answer })
    }

    pub(super) fn server(&self) -> &str {
        &self.server
    }

    /// Posts a text. Returns the status of the answer.
    ///
    /// # Errors
    /// When it is not taken, or that is not said within `timing.mailAnswer`.
    pub(super) async fn deliver(&self, text: &str) -> Result<String, MailError> {
        // Messengers take what is in angle brackets for links and calls.
        let text: Vec<String> = text.lines().map(client_text).collect();
        let mut connector = awc::Connector::new().timeout(self.time_limit);
        if let Some(config) = tls::client_config() {
            connector = connector.rustls_0_23(config);
        }
        // A redirect would send the notices to another server.
        let client = awc::Client::builder().connector(connector).timeout(self.time_limit).disable_redirects().finish();
        let request = client.post(self.url.reveal()).send_json(&json!({ "text": text.join("\n") }));
        match actix_rt::time::timeout(self.time_limit, request).await {
            Ok(Ok(answer)) if answer.status().is_success() => Ok(answer.status().to_string()),
            Ok(Ok(answer)) => Err(self.failure(&answer.status().to_string(), is_permanent(answer.status()))),
            Ok(Err(error)) => match tls::reason(&error) {
                Some(reason) => Err(self.failure(&reason, true)),
                None => Err(self.failure(&error.to_string(), false)),
            },
            Err(_) => Err(self.failure(&format!("no answer within {} s", self.time_limit.as_secs_f64()), false)),
        }
    }

    fn failure(&self, problem: &str, permanent: bool) -> MailError {
        MailError::Delivery { server: self.server.clone(), problem: client_text(problem), permanent }
    }
}

/// Whether the configuration or the messenger must change before another try can succeed.
fn is_permanent(status: StatusCode) -> bool {
    let temporary = [StatusCode::REQUEST_TIMEOUT, StatusCode::TOO_MANY_REQUESTS];
    !status.is_server_error() && !temporary.contains(&status)
}
