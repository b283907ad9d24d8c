//! A simulation that will run in containers.

use std::sync::Arc;

use super::build_plan::PROJECT_PATH;
use crate::simulation::checkout::Project;
use crate::simulation::config::{ContainerDisplay, SimulationConfig};
use crate::simulation::machine::sensors::Gpu;

/// A simulation that will run in containers.
#[derive(Debug)]
pub struct ContainerRequest {
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// The port of Webots.
    pub port: u16,
    /// The GPU that it was given; without one, it gets all.
    pub gpu: Option<Gpu>,
    /// Webots and its arguments, but for the world, which is the last.
    pub command: Vec<String>,
}

/// Runs a program on a virtual display; part of the images of Webots.
const VIRTUAL_DISPLAY: [&str; 2] = ["xvfb-run", "--auto-servernum"];

impl ContainerRequest {
    /// Webots and its arguments in the container, with this world of the project.
    #[must_use]
    pub fn command(&self, config: &SimulationConfig, world: &str) -> Vec<String> {
        let display = match config.container.display {
            ContainerDisplay::Virtual => &VIRTUAL_DISPLAY[..],
            ContainerDisplay::Machine => &[],
        };
        let display = display.iter().map(|word| (*word).to_owned());
        display.chain(self.command.iter().cloned()).chain([format!("{PROJECT_PATH}/{world}")]).collect()
    }
}
