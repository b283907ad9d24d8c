//! Actor: announces this server to other services at start.
//!
//! One for the whole server. It posts the form of the original to each address in `notify`, up to six times; no other
//! actor waits for it. It ends when each announcement has succeeded or been given up.

use std::time::Duration;

use actix::prelude::*;
use futures_util::future::join_all;

use super::config::SimulationConfig;
use crate::shared::http::tls;

/// Number of attempts for each address.
const TRIES: u32 = 6;
/// Timeout of an answer.
const ANSWER: Duration = Duration::from_secs(10);

/// Size limit of an answer, in bytes.
const LARGEST_ANSWER: usize = 64 * 1024;

/// An answer that refuses an announcement, although its status is 200.
#[derive(serde::Deserialize)]
struct Refusal {
    error: serde_json::Value,
}

/// The actor.
pub struct Announcer {
    addresses: Vec<String>,
    form: Vec<(&'static str, String)>,
    pause: Duration,
}

impl Announcer {
    /// Prepares the announcements of a server.
    pub fn new(config: &SimulationConfig) -> Self {
        let allowed: Vec<&str> =
            config.allowed_repositories.iter().map(crate::shared::domain::UrlPrefix::as_str).collect();
        let form = vec![
            ("url", config.http_url()),
            ("shareIdleTime", config.share_idle_time.to_string()),
            ("allowedRepositories", allowed.join(",")),
        ];
        Self { addresses: config.notify.clone(), form, pause: config.timing.announce }
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
                let body = answer.body().limit(LARGEST_ANSWER).await.unwrap_or_default();
                let Ok(Refusal { error }) = serde_json::from_slice(&body) else {
                    log::info!("announced to {address}");
                    return;
                };
                format!("it answered {error}")
            }
            Ok(answer) => format!("it answered {}", answer.status()),
            Err(error) => tls::reason(&error).unwrap_or_else(|| error.to_string()),
        };
        log::warn!("can't announce to {address} ({attempt} of {TRIES}): {problem}");
        actix_rt::time::sleep(pause).await;
    }
    log::error!("gave up announcing to {address}");
}

impl Actor for Announcer {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let (form, pause) = (self.form.clone(), self.pause);
        let announcements = self.addresses.drain(..).map(|address| announce(address, form.clone(), pause));
        join_all(announcements.collect::<Vec<_>>()).into_actor(self).map(|_, _, ctx| ctx.stop()).spawn(ctx);
    }
}
