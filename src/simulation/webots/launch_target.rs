//! What a Webots runs on: the machine with one of its displays, or containers.

use std::path::PathBuf;
use std::sync::Arc;

use tokio::sync::Notify;

use super::event::WebotsEvent;
use super::launch_spec::LaunchSpec;
use super::virtual_display::{VirtualDisplay, write_authority};
use crate::simulation::container::{Cause, ContainerRequest, ContainerService, SimulationContainers, StartError};
use crate::simulation::isolation::{Display, IsolationLevel};

/// What a Webots runs on.
#[derive(Debug)]
pub enum LaunchTarget {
    /// The machine, with a display of Webots' own in its sandbox or the configured one.
    Machine(Display),
    /// The machine, with a display of Webots' own beside it.
    BesideDisplay(VirtualDisplay),
    /// Containers.
    ContainerService(Box<SimulationContainers>),
}

/// What has to be done before a Webots can start.
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
    /// What has to be done for this Webots.
    #[must_use]
    pub fn of(spec: &LaunchSpec) -> Self {
        match &spec.containers {
            Some(containers) => Self::ContainerService(Arc::clone(containers), spec.request()),
            None if spec.config.xvfb => Self::Display(spec.project.instance.path().to_owned(), spec.launcher.level()),
            None => Self::None(spec.display()),
        }
    }

    /// Does it. `progress` hears each step in words. Dropping the future gives up what was made.
    ///
    /// # Errors
    /// Whose fault it is that it can't be done.
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
                Ok(LaunchTarget::ContainerService(Box::new(prepared)))
            }
        }
    }
}

impl LaunchTarget {
    /// Asks to start the controller of a competition's participant anew, where there is one.
    #[must_use]
    pub fn restart(&self) -> Option<Arc<Notify>> {
        match self {
            Self::Machine(_) | Self::BesideDisplay(_) => None,
            Self::ContainerService(containers) => containers.restart(),
        }
    }

    /// What the client should know of it.
    #[must_use]
    pub fn news(&self) -> Vec<WebotsEvent> {
        let Self::ContainerService(containers) = self else { return Vec::new() };
        let warnings = containers.warnings.iter().cloned().map(WebotsEvent::Progress);
        warnings.chain(containers.texts.iter().cloned().map(WebotsEvent::Text)).collect()
    }

    /// Ends what a Webots ran on, after its own end with this exit code. Returns what has ended it, if Docker knows.
    pub async fn end(self, code: Option<i32>) -> Option<Cause> {
        match self {
            Self::Machine(_) => None,
            Self::BesideDisplay(display) => {
                display.stop().await;
                None
            }
            Self::ContainerService(containers) => {
                let cause = containers.cause(code).await;
                containers.remove().await;
                cause
            }
        }
    }
}
