//! What the routes, the pages and the web clients of a session server share. Made by `app`.

use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;
use tokio::sync::watch;

use super::config::{Example, Timing};
use crate::session::fleet::Registry;
use crate::session::fleet::{NoServer, Pick};
use crate::shared::http::Connections;
use crate::shared::http::Live;
use crate::shared::http::Metrics;
use crate::shared::http::TrustedProxies;
use crate::shared::run::Phase;

/// What routes and web clients share.
pub struct AppState {
    /// Owns the fleet's state.
    pub registry: Addr<Registry>,
    /// Durations.
    pub timing: Timing,
    /// Whether URLs begin with `wss`.
    pub ssl: bool,
    /// Whether clients are taken.
    pub phase: watch::Receiver<Phase>,
    /// Counts WebSockets.
    pub connections: Connections,
    /// Whose word on clients' addresses is taken.
    pub trusted_proxies: TrustedProxies,
    /// What is counted.
    pub metrics: Metrics,
    /// Requests for a simulation server, by what came of them.
    pub picks: prometheus::IntCounterVec,
    /// Monitor pages that are open.
    pub live: Live,
    /// Worlds to try in the viewer.
    pub examples: Vec<Example>,
    /// Where Webots' own viewer comes from.
    pub viewer_script: Option<url::Url>,
    /// When the server was started.
    pub started: Instant,
    /// The same, as a time of day.
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
const PATIENCE: Duration = Duration::from_secs(2);

impl AppState {
    /// How many web clients are connected.
    #[must_use]
    pub fn clients(&self) -> usize {
        self.connections.count()
    }

    /// Asks for a simulation server, and puts the answer in the words of the protocol.
    pub async fn pick(&self, wanted: Result<Pick, NoServer>) -> Answer {
        let picked = match wanted {
            Ok(pick) => {
                let picked = actix_rt::time::timeout(PATIENCE, self.registry.send(pick)).await;
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
            Ok(address) => Answer { text: address.websocket_url(self.ssl), refusal: None },
            Err(refusal) => Answer { text: refusal.to_string(), refusal: Some(refusal) },
        }
    }
}
