//! The state that the routes, the pages and the web clients of a simulation server share. `app` makes it.

use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;
use tokio::sync::watch;

use super::config::SimulationConfig;
use super::ends::Ends;
use super::failed_starts::FailedStarts;
use super::sessions::Sessions;
use super::slots::SlotPool;
use super::streams::Streams;
use crate::shared::domain::AdmissionRules;
use crate::shared::domain::Load;
use crate::shared::domain::ProjectUrl;
use crate::shared::http::AddressQuota;
use crate::shared::http::BasicAuth;
use crate::shared::http::ConnectionLimiter;
use crate::shared::http::LiveUpdates;
use crate::shared::http::Metrics;
use crate::shared::run::{Phase, ServerCommand};
use crate::simulation::checkout::CheckoutService;
use crate::simulation::container::ContainerService;
use crate::simulation::isolation::{Launcher, Watcher};
use crate::simulation::machine::UsageMonitor;
use crate::simulation::machine::{LoadMonitor, Readings, Spread};
use crate::simulation::process::RunDir;

/// How many threads start Webots. One that starts a process waits until it runs its program, which takes long on a busy
/// machine. They live as long as the server: bubblewrap ends with the thread that has started it.
pub const WEBOTS_THREADS: usize = 4;

/// The shared state.
pub struct AppState {
    /// The effective configuration.
    pub config: Arc<SimulationConfig>,
    /// Which worlds may run.
    pub rules: AdmissionRules,
    /// Lends places.
    pub slots: Addr<SlotPool>,
    /// The sessions that their clients may come back to.
    pub sessions: Arc<Sessions>,
    /// The streams of running simulations.
    pub streams: Arc<Streams>,
    /// Reads the machine.
    pub load_monitor: Addr<LoadMonitor>,
    /// The newest readings of the machine.
    pub readings: watch::Receiver<Arc<Readings>>,
    /// Chooses the GPU of each simulation, where they are spread over several.
    pub spread: Option<Arc<Spread>>,
    /// Launches simulations at a level of isolation.
    pub launcher: Arc<Launcher>,
    /// Watches over simulations: what they take, and where they listen.
    pub watcher: Watcher,
    /// Makes the containers in which simulations run, where they do.
    pub containers: Option<Arc<ContainerService>>,
    /// Checks worlds out.
    pub checkouts: Arc<CheckoutService>,
    /// The folder of this run, with the folders of simulations in it.
    pub run: Arc<RunDir>,
    /// Whether clients are taken.
    pub phase: watch::Receiver<Phase>,
    /// Why the server can start no simulation, if so.
    pub problem: watch::Receiver<Option<String>>,
    /// The last starts that failed for a reason of this server's own.
    pub failed_starts: Arc<FailedStarts>,
    /// How simulations have ended.
    pub ends: Ends,
    /// Takes requests to drain.
    pub requests: tokio::sync::mpsc::Sender<ServerCommand>,
    /// The threads on which the actors of Webots run.
    pub webots_threads: [ArbiterHandle; WEBOTS_THREADS],
    /// Checks the administrator's password, where one is configured.
    pub admin_auth: Option<BasicAuth>,
    /// Limits and counts connections.
    pub connections: ConnectionLimiter,
    /// How often one address may ask for a simulation.
    pub start_quota: AddressQuota,
    /// The metrics.
    pub metrics: Metrics,
    /// Counts clients that asked for a simulation, by outcome.
    pub starts: prometheus::IntCounterVec,
    /// The open monitor pages.
    pub live: LiveUpdates,
    /// Those of administrators, which show more.
    pub administrators: LiveUpdates,
    /// CPU and memory of each simulation.
    pub usage: UsageMonitor,
    /// When the server was started.
    pub started: Instant,
}

impl AppState {
    /// Returns the thread for the Webots that was given this port.
    #[must_use]
    pub fn webots_thread(&self, port: u16) -> &ArbiterHandle {
        let [first, second, third, fourth] = &self.webots_threads;
        match port % 4 {
            0 => first,
            1 => second,
            2 => third,
            _ => fourth,
        }
    }

    /// Returns the load to report: 100 % while the server is draining or can start no simulation.
    #[must_use]
    pub fn load(&self) -> Load {
        if self.takes_nobody() { Load::FULL } else { self.readings.borrow().load.unwrap_or(Load::ZERO) }
    }

    /// Whether no client can have a simulation here, whatever its world is.
    #[must_use]
    pub fn takes_nobody(&self) -> bool {
        self.is_draining() || self.problem.borrow().is_some()
    }

    /// Whether new clients are refused.
    #[must_use]
    pub fn is_draining(&self) -> bool {
        *self.phase.borrow() != Phase::Open
    }

    /// Checks whether a world may run here now: its URL, the rules, and that the server takes clients.
    ///
    /// # Errors
    /// The reason why not, in words for the client.
    pub fn admit(&self, url: &str) -> Result<ProjectUrl, String> {
        let world = ProjectUrl::parse(url).map_err(|wrong| wrong.to_string())?;
        if self.is_draining() {
            return Err("This simulation server is about to end, and takes no new clients".to_owned());
        }
        if let Some(problem) = self.problem() {
            return Err(problem);
        }
        self.rules.admit(&world, self.load()).map_err(|refusal| refusal.to_string())?;
        Ok(world)
    }

    /// Returns why this server can start no simulation at all, if so.
    #[must_use]
    pub fn problem(&self) -> Option<String> {
        self.problem.borrow().clone()
    }
}
