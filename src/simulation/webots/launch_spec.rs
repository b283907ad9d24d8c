//! What a Webots is started with.

use std::path::PathBuf;
use std::sync::Arc;

use actix::prelude::*;

use super::command::Launch;
use super::event::WebotsEvent;
use crate::simulation::checkout::{Checkouts, Project};
use crate::simulation::config::SimulationConfig;
use crate::simulation::machine::display;
use crate::simulation::places::Ticket;
use crate::simulation::process::process_group::Plan;
use crate::simulation::protocol::Mode;

/// What a Webots is started with.
pub struct Orders {
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
    /// Who hears of it.
    pub events: Recipient<WebotsEvent>,
}

impl Orders {
    /// How it is started and ended.
    #[must_use]
    pub fn plan(&self) -> Plan {
        let launch = Launch {
            program: &self.program,
            mode: self.mode,
            port: self.place.1,
            heartbeat: self.config.timing.heartbeat,
            world: &self.project.world.path,
            xvfb: self.config.xvfb,
            instance: self.project.instance.path(),
        };
        let display = display::effective(self.config.display.as_ref());
        Plan {
            command: launch.arguments(),
            environment: vec![("DISPLAY".into(), display.into())],
            folder: Some(self.project.folder().to_owned()),
            mark: self.project.instance.path().to_owned(),
            remove: Some(self.project.instance.path().to_owned()),
            grace: self.config.timing.grace,
        }
    }
}
