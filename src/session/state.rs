//! The state that the routes, the pages and the web clients of a session server share. `app` creates it.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_web::error::ErrorServiceUnavailable;
use tokio::sync::{Mutex, watch};

use super::config::SessionConfig;
use crate::session::class::Roster;
use crate::session::fleet::{FleetStatus, GetStatus, GetWaiting, Pick, ReadyRequests, Registry, Wait};
use crate::session::line::Place;
use crate::shared::domain::{ClientUrls, Failure, FleetKey, ProjectUrl, PublicAddress, Reason};
use crate::shared::http::{AdminAuth, ConnectionKind, ConnectionLimiter, LiveUpdates, Metrics, SharedPage};
use crate::shared::run::Phase;

/// The label of requests for which a simulation server is chosen; the label of the others is the code of their reason.
pub const PLACED: &str = "placed";

/// How long the roster keeps who waits.
const LINE_AGE: Duration = Duration::from_millis(500);

/// The shared state.
pub struct AppState {
    /// The registry of simulation servers.
    pub registry: Addr<Registry>,
    /// What `POST /ready` has asked for.
    pub ready_requests: ReadyRequests,
    /// All simulations of the fleet, and who waits.
    pub roster: Arc<Roster>,
    /// This run of the server, to which the versions of the roster belong.
    pub run: u64,
    /// When the roster was last told who waits.
    pub line_seen: Mutex<Option<Instant>>,
    /// Whether a simulation server can take a client; the registry publishes it.
    pub available: watch::Receiver<bool>,
    /// Signs tickets and passes.
    pub key: FleetKey,
    /// The configuration from the start of the server: only the registry applies a reloaded one.
    pub config: Arc<SessionConfig>,
    /// Forms the URLs of simulation servers for clients.
    pub client_urls: ClientUrls,
    /// Whether the server accepts clients.
    pub phase: watch::Receiver<Phase>,
    /// Limits and counts connections.
    pub connections: ConnectionLimiter,
    /// Counters for `/metrics`.
    pub metrics: Metrics,
    /// Counts requests for a simulation server, by outcome: [`PLACED`] or a reason.
    pub picks: prometheus::IntCounterVec,
    /// The monitor page.
    pub monitor: SharedPage,
    /// The open monitor pages.
    pub live: LiveUpdates,
    /// The administrator's announcement: one line of text, never markup; empty if there is none.
    pub announcement: watch::Sender<String>,
    /// Tells administrators from others.
    pub admin_auth: Arc<AdminAuth>,
    /// When the server was started.
    pub started: Instant,
}

impl AppState {
    /// Number of connected web clients.
    pub fn clients(&self) -> usize {
        self.connections.count(ConnectionKind::Client)
    }

    /// Asks the registry for the status of the fleet.
    ///
    /// # Errors
    /// Once the registry has stopped, and the server with it.
    pub async fn status(&self) -> Result<Arc<FleetStatus>, actix_web::Error> {
        self.registry
            .send(GetStatus)
            .await
            .map_err(|_| ErrorServiceUnavailable("Error: the server stops."))
    }

    /// Tells the roster who waits in the line, unless it was told just now.
    pub async fn look_at_line(&self) {
        let mut seen = self.line_seen.lock().await;
        if seen.is_none_or(|at| at.elapsed() >= LINE_AGE)
            && let Ok(waiting) = self.registry.send(GetWaiting).await
        {
            self.roster.set_waiting(waiting);
            *seen = Some(Instant::now());
        }
    }

    /// Asks the registry for a simulation server for the client at the address `from`, and returns the server's URL.
    /// `world` is the world's URL, if the client named one.
    ///
    /// # Errors
    /// Why no server is available.
    pub async fn pick(&self, world: Option<&str>, from: Option<IpAddr>) -> Result<String, Failure> {
        let picked = self.pick_address(world, from).await;
        let outcome = picked.as_ref().map_or_else(|failure| failure.reason.code(), |_| PLACED);
        self.picks.with_label_values(&[outcome]).inc();
        picked.map(|address| self.client_urls.websocket_url(&address))
    }

    async fn pick_address(&self, world: Option<&str>, from: Option<IpAddr>) -> Result<PublicAddress, Failure> {
        let named = world.filter(|text| !text.is_empty());
        let world = named.map(read_world).transpose()?;
        self.registry
            .send(Pick { world, from })
            .await
            .unwrap_or_else(|_| Err(stopping()))
    }

    /// Asks the registry for a place in the line. Counts a refusal like those of [`AppState::pick`].
    ///
    /// # Errors
    /// Why the client may not wait.
    pub async fn wait(&self, wait: Wait) -> Result<Option<Place>, Failure> {
        let entered = self.registry.send(wait).await.unwrap_or_else(|_| Err(stopping()));
        if let Err(failure) = &entered {
            self.picks.with_label_values(&[failure.reason.code()]).inc();
        }
        entered
    }
}

/// Reads the URL of a world.
///
/// # Errors
/// When it is not valid.
pub fn read_world(text: &str) -> Result<ProjectUrl, Failure> {
    ProjectUrl::parse(text).map_err(|error| {
        let text = error.to_string();
        Failure::new(Reason::InvalidWorld, text.trim_end_matches('.'))
    })
}

fn stopping() -> Failure {
    Failure::new(Reason::Draining, "the session server stops")
}
