//! A simulation that will run in containers.

use std::sync::Arc;

use super::build_plan::PROJECT_PATH;
use crate::simulation::checkout::Project;
use crate::simulation::config::{ContainerDisplay, SimulationConfig};
use crate::simulation::machine::sensors::Gpu;

/// Creates a command from the world's path in the container.
pub type Command = Box<dyn Fn(&str) -> Vec<String> + Send>;

/// A simulation that will run in containers.
pub struct ContainerRequest {
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// The port of Webots.
    pub port: u16,
    /// The GPU that it was given; without one, it gets all.
    pub gpu: Option<Gpu>,
    /// Webots and its arguments, given where its world is in the container.
    pub command: Command,
}

impl std::fmt::Debug for ContainerRequest {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "ContainerRequest on port {}", self.port)
    }
}

/// Runs a program on a virtual display; part of the images of Webots.
const VIRTUAL_DISPLAY: [&str; 2] = ["xvfb-run", "--auto-servernum"];

/// Webots and its arguments in the container.
#[must_use]
pub fn command(config: &SimulationConfig, request: &ContainerRequest, world: &str) -> Vec<String> {
    let webots = (request.command)(&format!("{PROJECT_PATH}/{world}"));
    let display = match config.container.display {
        ContainerDisplay::Virtual => &VIRTUAL_DISPLAY[..],
        ContainerDisplay::Machine => &[],
    };
    display.iter().map(|word| (*word).to_owned()).chain(webots).collect()
}
