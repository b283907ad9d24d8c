//! The target on which a Webots runs: the machine with one of its displays, or containers.

use std::sync::Arc;

use super::launch_spec::LaunchSpec;
use crate::simulation::container::{SimulationContainers, StartError};
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
    pub fn prepare<P: Fn(String) + Send + Sync + 'static>(
        spec: &LaunchSpec,
        progress: P,
    ) -> impl Future<Output = Result<Self, StartError>> + use<P> {
        let containers = spec.containers.as_ref().map(|containers| (Arc::clone(containers), spec.request()));
        let (xvfb, display, instance) = (spec.config.xvfb, spec.display(), spec.project.instance.path().to_owned());
        async move {
            if let Some((containers, request)) = containers {
                let mut prepared = containers.prepare(request, &progress).await?;
                prepared.start_others().await?;
                return Ok(Self::Containers(Box::new(prepared)));
            }
            let display = if xvfb { Display::new_virtual(&instance) } else { Ok(Display::Outside(display)) };
            let failed = |error| StartError::Server(format!("The virtual display (Xvfb) can't be started: {error}"));
            display.map(Self::Machine).map_err(failed)
        }
    }
}
