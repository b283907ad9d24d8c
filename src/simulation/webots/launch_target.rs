//! The target on which a Webots runs: the machine with one of its displays, or containers.

use std::path::PathBuf;
use std::sync::Arc;

use tokio::sync::Notify;

use super::event::WebotsEvent;
use super::launch_spec::LaunchSpec;
use super::virtual_display::{VirtualDisplay, write_authority};
use crate::simulation::container::{Cause, ContainerRequest, ContainerService, SimulationContainers, StartError};
use crate::simulation::isolation::{Display, IsolationLevel};

/// The target on which a Webots runs.
#[derive(Debug)]
pub enum LaunchTarget {
    /// The machine, with a display of Webots' own in its sandbox or the configured one.
    Machine(Display),
    /// The machine, with a display of Webots' own beside it.
    BesideDisplay(VirtualDisplay),
    /// Containers.
    Containers(Box<SimulationContainers>),
}

/// The preparation of a Webots' start.
#[derive(Debug)]
pub enum Preparation {
    /// Nothing: it has the display with this name.
    None(String),
    /// Its own display has to be started, in its sandbox or beside it; it keeps its files in the instance's folder.
    Display(PathBuf, IsolationLevel),
    /// Containers have to be made.
    ContainerService(Arc<ContainerService>, ContainerRequest),
}

impl Preparation {
    /// The preparation that this Webots needs.
    pub fn of(spec: &LaunchSpec) -> Self {
        match &spec.containers {
            Some(containers) => Self::ContainerService(Arc::clone(containers), spec.request()),
            None if spec.config.xvfb => Self::Display(spec.project.instance.path().to_owned(), spec.launcher.level()),
            None => Self::None(spec.display()),
        }
    }

    /// Runs it. `progress` receives each step as text. Dropping the future discards what was created.
    ///
    /// # Errors
    /// Why it failed, and whether the project or this server is the cause.
    pub async fn run(self, progress: impl Fn(String) + Send + Sync) -> Result<LaunchTarget, StartError> {
        match self {
            Self::None(name) => Ok(LaunchTarget::Machine(Display::Outside(vec![("DISPLAY".into(), name.into())]))),
            Self::Display(instance, level) => {
                let started = if level == IsolationLevel::Sandbox {
                    write_authority(&instance).and_then(Display::inside).map(LaunchTarget::Machine)
                } else {
                    VirtualDisplay::start(&instance).await.map(LaunchTarget::BesideDisplay)
                };
                let failed =
                    |error| StartError::Server(format!("The virtual display (Xvfb) can't be started: {error}"));
                started.map_err(failed)
            }
            Self::ContainerService(containers, request) => {
                let mut prepared = containers.prepare(request, &progress).await?;
                prepared.start_others().await?;
                Ok(LaunchTarget::Containers(Box::new(prepared)))
            }
        }
    }
}

impl LaunchTarget {
    /// Restarts the controller of a competition's participant; `None` if there is none.
    pub fn restart(&self) -> Option<Arc<Notify>> {
        match self {
            Self::Machine(_) | Self::BesideDisplay(_) => None,
            Self::Containers(containers) => containers.restart(),
        }
    }

    /// The events for the client about it.
    pub fn news(&self) -> Vec<WebotsEvent> {
        let Self::Containers(containers) = self else { return Vec::new() };
        let warnings = containers.warnings.iter().cloned().map(WebotsEvent::Progress);
        warnings.chain(containers.texts.iter().cloned().map(WebotsEvent::Text)).collect()
    }

    /// Ends the target, after the Webots on it has ended with this exit code. Returns the cause of its end, if Docker
    /// reports one.
    pub async fn end(self, code: Option<i32>) -> Option<Cause> {
        match self {
            Self::Machine(_) => None,
            Self::BesideDisplay(display) => {
                display.stop().await;
                None
            }
            Self::Containers(containers) => {
                let cause = containers.cause(code).await;
                containers.remove().await;
                cause
            }
        }
    }
}
