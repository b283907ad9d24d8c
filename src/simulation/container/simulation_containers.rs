//! The containers of one simulation, created and ready to start. Dropping them removes them.

use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use tokio::sync::Notify;
use tokio_util::task::AbortOnDropHandle;

use super::compose_project::{CONTROLLER, WEBOTS, container_of};
use super::docker::{Docker, DockerError, SHORT_TIMEOUT, daemon_fault};
use super::failures::refused_by_docker;
use super::owned_resources::ProjectGuard;
use crate::shared::domain::Failure;
use crate::simulation::process::{Cause, ExitReason, SpawnSpec};

/// The containers of one simulation.
#[derive(Debug)]
pub struct SimulationContainers {
    /// Runs Docker.
    pub(super) docker: Docker,
    /// `diskReserve`, in MiB.
    pub(super) reserve: u64,
    /// The name of its compose project.
    pub(super) guard: ProjectGuard,
    /// Its services, each with a container.
    pub(super) services: Vec<&'static str>,
    /// Whether the project has defined one of their images, which may be why Docker can't start one.
    pub(super) is_projects: bool,
    /// Texts for its client, unchanged.
    pub texts: Vec<String>,
    /// Warnings for its client.
    pub warnings: Vec<String>,
    /// Restarts the participant's controller; `None` if there is none.
    pub(super) restart: Option<(Arc<Notify>, AbortOnDropHandle<()>)>,
}

/// Shortest time between two restarts of a participant's controller.
const RESTART_INTERVAL: Duration = Duration::from_secs(1);

impl SimulationContainers {
    fn container(&self, service: &str) -> String {
        container_of(&self.guard.name, service)
    }

    /// The process that starts Webots' container, prints its output, and exits with its exit code.
    pub fn spawn_spec(&self, grace: Duration) -> SpawnSpec {
        let webots = self.container(WEBOTS);
        self.docker
            .spec(["docker", "start", "--attach", &webots].map(Into::into).to_vec(), grace)
    }

    /// Starts the other services. That must happen before Webots is started, so that no symlink of a world's program
    /// can redirect their mounts.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn start_others(&mut self) -> Result<(), Failure> {
        let others = self
            .services
            .iter()
            .filter(|service| **service != WEBOTS)
            .map(|service| self.container(service));
        let words: Vec<String> = std::iter::once("start".to_owned()).chain(others).collect();
        if words.len() > 1
            && let Err(error) = self.docker.run(&words, SHORT_TIMEOUT).await
        {
            let otherwise = refused_by_docker(self.is_projects);
            return Err(self.docker.explain(error, self.reserve, otherwise).await);
        }
        if self.services.contains(&CONTROLLER) {
            let docker = self.docker.clone();
            let controller = self.container(CONTROLLER);
            let request = Arc::new(Notify::new());
            let requested = Arc::clone(&request);
            let restarts = async move {
                loop {
                    requested.notified().await;
                    if let Err(error) = docker
                        .run(&["restart", "--time", "0", &controller], SHORT_TIMEOUT)
                        .await
                    {
                        log::warn!("a participant's controller is not started anew: {error}");
                    }
                    actix_rt::time::sleep(RESTART_INTERVAL).await;
                }
            };
            self.restart = Some((request, AbortOnDropHandle::new(actix_rt::spawn(restarts))));
        }
        Ok(())
    }

    /// Restarts the participant's controller on notification, as the original does when Webots was reset.
    pub fn restart(&self) -> Option<Arc<Notify>> {
        self.restart.as_ref().map(|(request, _)| Arc::clone(request))
    }

    /// Why Webots' container has ended, given how the program `docker` has; `None` if Docker knows no more.
    pub async fn cause(&self, ended: ExitReason) -> Option<Cause> {
        let ExitReason::Code(code) = ended else { return None };
        let webots = self.container(WEBOTS);
        let format = "{{.State.OOMKilled}} {{.State.Status}} {{.State.ExitCode}}";
        let state = match self
            .docker
            .run(&["inspect", "--format", format, &webots], SHORT_TIMEOUT)
            .await
        {
            Ok(state) => state,
            Err(DockerError::Failed { .. }) => {
                let fault = spawn_blocking(daemon_fault).await;
                return fault.ok().flatten().map(|_| Cause::Docker);
            }
            Err(_) => return Some(Cause::Docker),
        };
        match state.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["true", ..] => Some(Cause::MemoryLimit),
            [_, "created", _] => (!self.is_projects).then_some(Cause::NotStarted),
            // The program has lost the connection to the daemon.
            [_, _, ended] if *ended != code.to_string() => Some(Cause::Docker),
            _ => None,
        }
    }

    /// Removes everything of this simulation.
    pub async fn remove(self) {
        self.guard.remove().await;
    }
}
