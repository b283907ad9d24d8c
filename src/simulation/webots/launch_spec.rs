//! The launch specification: everything that one Webots is started with.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::Arc;

use actix::prelude::*;

use super::command::WebotsCommand;
use super::event::WebotsEvent;
use crate::simulation::checkout::{Checkouts, Project};
use crate::simulation::config::SimulationConfig;
use crate::simulation::places::Ticket;
use crate::simulation::process::SpawnSpec;
use crate::simulation::protocol::Mode;

/// Everything that one Webots is started with.
pub struct LaunchSpec {
    /// The server's configuration.
    pub config: Arc<SimulationConfig>,
    /// The program to start.
    pub program: PathBuf,
    /// Where controllers are restored from.
    pub checkouts: Arc<Checkouts>,
    /// What was checked out.
    pub project: Arc<Project>,
    /// How it is shown.
    pub mode: Mode,
    /// The place, and its port.
    pub place: (Ticket, u16),
    /// Who gets the events.
    pub events: Recipient<WebotsEvent>,
}

impl LaunchSpec {
    /// How the process is started and ended. `display` holds the environment variables that name its X display.
    #[must_use]
    pub fn spawn_spec(&self, display: Vec<(OsString, OsString)>) -> SpawnSpec {
        let command = WebotsCommand {
            program: &self.program,
            mode: self.mode,
            port: self.place.1,
            heartbeat: self.config.timing.heartbeat,
            world: &self.project.world.path,
        };
        SpawnSpec {
            command: command.to_arguments(),
            environment: display,
            folder: Some(self.project.folder().to_owned()),
            mark: self.project.instance.path().to_owned(),
            grace: self.config.timing.grace,
        }
    }
}
