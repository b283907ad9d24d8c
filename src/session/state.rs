//! The state that the routes, the pages and the web clients of a session server share. `app` makes it.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;
use tokio::sync::watch;

use super::announcements::Announcements;
use super::config::{Example, Timing};
use crate::session::fleet::Registry;
use crate::session::fleet::{NoServer, Pick};
use crate::shared::domain::ClientUrls;
use crate::shared::http::BasicAuth;
use crate::shared::http::Live;
use crate::shared::http::Metrics;
use crate::shared::http::TrustedProxies;
use crate::shared::http::{Connections, Kind};
use crate::shared::run::Phase;
use crate::shared::text::client_text;

/// The shared state.
pub struct AppState {
    /// The registry of simulation servers.
    pub registry: Addr<Registry>,
    /// Whether a simulation server can take a client; the registry publishes it.
    pub available: watch::Receiver<bool>,
    /// `timing` of the configuration.
    pub timing: Timing,
    /// How the URLs of simulation servers are formed for clients.
    pub client_urls: ClientUrls,
    /// Whether clients are taken.
    pub phase: watch::Receiver<Phase>,
    /// Limits and counts connections.
    pub connections: Connections,
    /// Web servers whose headers are believed.
    pub trusted_proxies: TrustedProxies,
    /// The metrics.
    pub metrics: Metrics,
    /// Counts requests for a simulation server, by outcome.
    pub picks: prometheus::IntCounterVec,
    /// The open monitor pages.
    pub live: Live,
    /// What the administrator tells everybody.
    pub announcements: Arc<Announcements>,
    /// Checks the administrator's password, where one is configured.
    pub admin_auth: Option<BasicAuth>,
    /// The examples on the page `/viewer`.
    pub examples: Vec<Example>,
    /// URL of Webots' own viewer.
    pub viewer_script: Option<url::Url>,
    /// When the server was started.
    pub started: Instant,
    /// The same moment as a time of day.
    pub started_at: SystemTime,
}

/// The answer to a request for a simulation server.
pub struct Answer {
    /// A URL, or `Error: ...`.
    pub text: String,
    /// Why there is no URL.
    pub refusal: Option<NoServer>,
}

/// How long the registry may take to pick a server.
const PICK_TIMEOUT: Duration = Duration::from_secs(2);

impl AppState {
    /// Returns how many web clients are connected.
    pub fn clients(&self) -> usize {
        self.connections.count(Kind::Client)
    }

    /// Asks the registry for a simulation server. A registry that does not answer in time counts as unavailable.
    pub async fn pick(&self, wanted: Result<Pick, NoServer>) -> Answer {
        let picked = match wanted {
            Ok(pick) => {
                let picked = actix_rt::time::timeout(PICK_TIMEOUT, self.registry.send(pick)).await;
                picked.ok().and_then(Result::ok).unwrap_or(Err(NoServer::Unavailable))
            }
            Err(wrong) => Err(wrong),
        };
        let outcome = match &picked {
            Ok(_) => "placed",
            Err(NoServer::Unavailable) => "unavailable",
            Err(NoServer::NotAccepted(_)) => "not_accepted",
            Err(NoServer::NoWorld(_)) => "wrong_url",
        };
        self.picks.with_label_values(&[outcome]).inc();
        match picked {
            Ok(address) => Answer { text: self.client_urls.websocket_url(&address), refusal: None },
            // These words hold nothing from outside.
            Err(NoServer::Unavailable) => {
                Answer { text: NoServer::Unavailable.to_string(), refusal: Some(NoServer::Unavailable) }
            }
            Err(refusal) => Answer { text: client_text(&refusal.to_string()), refusal: Some(refusal) },
        }
    }
}
