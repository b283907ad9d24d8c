//! The state that the routes, the pages and the web clients of a simulation server share. `app` makes it.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;
use tokio::sync::watch;
use which::which;

use super::config::SimulationConfig;
use super::places::Places;
use crate::shared::domain::Load;
use crate::shared::domain::ProjectUrl;
use crate::shared::domain::Rules;
use crate::shared::http::BasicAuth;
use crate::shared::http::Connections;
use crate::shared::http::Live;
use crate::shared::http::Metrics;
use crate::shared::run::{Phase, Request};
use crate::simulation::checkout::Checkouts;
use crate::simulation::machine::UsageMonitor;
use crate::simulation::machine::{LoadMonitor, Readings};
use crate::simulation::process::RunDir;

/// The shared state.
pub struct AppState {
    /// The effective configuration.
    pub config: Arc<SimulationConfig>,
    /// Which worlds may run.
    pub rules: Rules,
    /// Lends places.
    pub places: Addr<Places>,
    /// Reads the machine.
    pub load_monitor: Addr<LoadMonitor>,
    /// The newest readings of the machine.
    pub readings: watch::Receiver<Arc<Readings>>,
    /// Checks worlds out.
    pub checkouts: Arc<Checkouts>,
    /// The folder of this run, with the folders of simulations in it.
    pub run: Arc<RunDir>,
    /// Whether clients are taken.
    pub phase: watch::Receiver<Phase>,
    /// Takes requests to drain.
    pub requests: tokio::sync::mpsc::Sender<Request>,
    /// The thread on which the actors of Webots run.
    pub main_thread: ArbiterHandle,
    /// Checks the administrator's password, where one is configured.
    pub admin_auth: Option<BasicAuth>,
    /// Counts connections.
    pub connections: Connections,
    /// The metrics.
    pub metrics: Metrics,
    /// Counts clients that asked for a simulation, by outcome.
    pub starts: prometheus::IntCounterVec,
    /// The open monitor pages.
    pub live: Live,
    /// CPU and memory of each simulation.
    pub usage: UsageMonitor,
    /// When the server was started.
    pub started: Instant,
}

impl AppState {
    /// Returns the load to report: 100 % while the server is draining.
    #[must_use]
    pub fn load(&self) -> Load {
        if self.is_draining() { Load::FULL } else { self.readings.borrow().load.unwrap_or(Load::ZERO) }
    }

    /// Whether new clients are refused.
    #[must_use]
    pub fn is_draining(&self) -> bool {
        *self.phase.borrow() != Phase::Open
    }

    /// Checks whether a world may run here now: its URL, the rules, and that Webots is there, so that nobody waits for a
    /// checkout in vain.
    ///
    /// # Errors
    /// The reason why not, in words for the client.
    pub fn admit(&self, url: &str) -> Result<ProjectUrl, String> {
        let world = ProjectUrl::parse(url).map_err(|wrong| wrong.to_string())?;
        if self.is_draining() {
            return Err("This simulation server is about to end, and takes no new clients".to_owned());
        }
        self.rules.admit(&world, self.load()).map_err(|refusal| refusal.to_string())?;
        self.webots_program()?;
        Ok(world)
    }

    /// Returns the program that is started for each client.
    ///
    /// # Errors
    /// When it is not there, or `xvfb-run` is missing; in words for the client.
    pub fn webots_program(&self) -> Result<PathBuf, String> {
        if self.config.xvfb && which("Xvfb").is_err() {
            return Err("This simulation server gives each Webots a display of its own (xvfb), but has no Xvfb. \
                        Its administrator can install it, or set xvfb: false and display"
                .to_owned());
        }
        let how = "Its administrator can set webotsHome in the server's configuration, or the environment variable \
                   WEBOTS_HOME";
        let Some(program) = self.config.webots_program() else {
            return Err(format!("This simulation server does not know where Webots is installed. {how}."));
        };
        let program = std::path::absolute(&program).unwrap_or(program);
        if program.is_file() {
            Ok(program)
        } else {
            Err(format!("This simulation server has no Webots at {}. {how}.", program.display()))
        }
    }
}
