//! Announces this server to other services at start: posts the form of the original to each address in `notify`, in the
//! background and up to six times.

use std::time::Duration;

use super::config::SimulationConfig;
use crate::shared::domain::UrlPrefix;
use crate::shared::http::tls;
use crate::shared::text::excerpt;

/// Number of attempts for each address.
const TRIES: u32 = 6;
/// Timeout of an answer.
const ANSWER: Duration = Duration::from_secs(10);

/// Size limit of an answer, in bytes.
const MAX_ANSWER_SIZE: usize = 64 * 1024;
/// Longest excerpt of an answer in the log, in characters.
const SHOWN: usize = 200;

/// Starts the announcements of a server.
pub fn start(config: &SimulationConfig) {
    let allowed: Vec<&str> = config.allowed_repositories.iter().map(UrlPrefix::as_str).collect();
    // Worlds of other repositories run in containers only.
    let share_idle_time = if config.docker { config.share_idle_time } else { 0.0 };
    let form = vec![
        ("url", config.http_url()),
        ("shareIdleTime", share_idle_time.to_string()),
        ("allowedRepositories", allowed.join(",")),
    ];
    for address in &config.notify {
        actix_rt::spawn(announce(address.to_string(), form.clone(), config.timing.announce));
    }
}

async fn announce(address: String, form: Vec<(&'static str, String)>, pause: Duration) {
    let mut connector = awc::Connector::new();
    if let Some(config) = tls::client_config() {
        connector = connector.rustls_0_23(config);
    }
    let client = awc::Client::builder().connector(connector).timeout(ANSWER).finish();
    for attempt in 1..=TRIES {
        let problem = match client.post(&address).send_form(&form).await {
            Ok(mut answer) if answer.status().is_success() => {
                let body = answer.body().limit(MAX_ANSWER_SIZE).await.unwrap_or_default();
                let text = excerpt(&String::from_utf8_lossy(&body), SHOWN);
                if is_refusal(&body) {
                    log::warn!("{address} refuses this server: {text:?}");
                } else {
                    log::info!("announced to {address}, which answered {text:?}");
                }
                return;
            }
            Ok(answer) => format!("it answered {}", answer.status()),
            Err(error) => tls::reason(&error).unwrap_or_else(|| error.to_string()),
        };
        log::warn!("can't announce to {address} ({attempt} of {TRIES}): {problem}");
        actix_rt::time::sleep(pause).await;
    }
    log::error!("gave up announcing to {address}");
}

/// Whether the body of an answer with status 200 is `{"error": ...}`, as webots.cloud refuses.
fn is_refusal(body: &[u8]) -> bool {
    let answer: Result<serde_json::Value, _> = serde_json::from_slice(body);
    answer.is_ok_and(|answer| answer.get("error").is_some_and(|error| !error.is_null()))
}
