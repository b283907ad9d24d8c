//! The target on which a Webots runs: the machine with one of its displays, or containers.

use std::future::ready;
use std::sync::Arc;

use futures_util::FutureExt;
use futures_util::future::LocalBoxFuture;
use tokio::sync::Notify;

use super::event::WebotsEvent;
use super::launch_spec::LaunchSpec;
use crate::simulation::container::{Cause, SimulationContainers, StartError};
use crate::simulation::isolation::Display;

/// The target on which a Webots runs.
pub enum LaunchTarget {
    /// The machine, with this display.
    Machine(Display),
    /// Containers.
    Containers(Box<SimulationContainers>),
}

impl LaunchTarget {
    /// Prepares the target of a Webots: containers, a display of its own, or nothing. `progress` receives each step as text.
    /// Dropping the future discards what was created. Its error says why it failed, and whether the project or this server
    /// is the cause.
    pub fn prepare(
        spec: &LaunchSpec,
        progress: impl Fn(String) + Send + Sync + 'static,
    ) -> LocalBoxFuture<'static, Result<Self, StartError>> {
        if let Some(containers) = &spec.containers {
            let (containers, request) = (Arc::clone(containers), spec.request());
            let prepare = async move {
                let mut prepared = containers.prepare(request, &progress).await?;
                prepared.start_others().await?;
                Ok(Self::Containers(Box::new(prepared)))
            };
            return prepare.boxed_local();
        }
        let display = if spec.config.xvfb {
            Display::new_virtual(spec.project.instance.path())
        } else {
            Ok(Display::Outside(spec.display()))
        };
        let failed = |error| StartError::Server(format!("The virtual display (Xvfb) can't be started: {error}"));
        ready(display.map(Self::Machine).map_err(failed)).boxed_local()
    }

    /// Restarts the controller of a competition's participant; `None` if there is none.
    pub fn restart(&self) -> Option<Arc<Notify>> {
        match self {
            Self::Machine(_) => None,
            Self::Containers(containers) => containers.restart(),
        }
    }

    /// The events for the client about it.
    pub fn events(&self) -> Vec<WebotsEvent> {
        let Self::Containers(containers) = self else { return Vec::new() };
        let warnings = containers.warnings.iter().cloned().map(WebotsEvent::Progress);
        warnings.chain(containers.texts.iter().cloned().map(WebotsEvent::Text)).collect()
    }

    /// Ends the target, after the Webots on it has ended with this exit code. Returns the cause of its end, if Docker
    /// reports one.
    pub async fn end(self, code: Option<i32>) -> Option<Cause> {
        match self {
            Self::Machine(_) => None,
            Self::Containers(containers) => {
                let cause = containers.cause(code).await;
                containers.remove().await;
                cause
            }
        }
    }
}
