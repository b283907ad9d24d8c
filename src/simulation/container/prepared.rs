//! The containers of one simulation: made, and ready to be started. Whoever drops them gives them up to be removed.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Notify;
use tokio_util::task::AbortOnDropHandle;

use super::docker::{Docker, DockerError, SHORT};
use super::objects;
use super::tidy::Live;
use crate::simulation::process::SpawnSpec;

/// The containers of one simulation.
#[derive(Debug)]
pub struct Prepared {
    docker: Docker,
    lease: Lease,
    /// The container of each service.
    containers: Vec<(String, String)>,
    /// Texts that its client gets as they are.
    pub texts: Vec<String>,
    /// What its client should know.
    pub warnings: Vec<String>,
    /// Asks to start the participant's controller anew, where there is one.
    restart: Option<(Arc<Notify>, AbortOnDropHandle<()>)>,
}

/// The name of a compose project. As long as this lives, its containers are not taken for what somebody has left.
#[derive(Debug)]
pub struct Lease {
    /// The name.
    pub name: String,
    live: Live,
}

/// What has ended a container.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The kernel, because it took more memory than it may.
    OutOfMemory,
    /// Docker, which was stopped or has crashed.
    Docker,
}

/// The exit code of a program that was asked to end, as Docker asks all when it is stopped.
const TERMINATED: i32 = 143;
/// The time between two starts of a participant's controller, at least.
const BETWEEN_RESTARTS: Duration = Duration::from_secs(1);
/// The service of a participant's controller.
const CONTROLLER: &str = "controller";
/// The service of Webots.
const WEBOTS: &str = "webots";

impl Lease {
    /// Takes a name.
    #[must_use]
    pub fn take(name: String, live: &Live) -> Self {
        live.insert(&name);
        Self { name, live: live.clone() }
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.live.remove(&self.name);
    }
}

impl Prepared {
    /// The containers of a project that was made: pairs of service and container.
    #[must_use]
    pub fn new(
        docker: Docker,
        lease: Lease,
        containers: Vec<(String, String)>,
        texts: Vec<String>,
        warnings: Vec<String>,
    ) -> Self {
        Self { docker, lease, containers, texts, warnings, restart: None }
    }

    fn of(&self, service: &str) -> Option<&str> {
        self.containers.iter().find(|(name, _)| name == service).map(|(_, container)| container.as_str())
    }

    /// The process that starts Webots' container, prints what that prints, and ends with its exit code.
    #[must_use]
    pub fn spawn_spec(&self, grace: Duration) -> SpawnSpec {
        let webots = self.of(WEBOTS).unwrap_or_default();
        self.docker.spec(["docker", "start", "--attach", webots].map(Into::into).to_vec(), grace)
    }

    /// Starts what runs beside Webots. It must be before Webots: nothing that a world's program makes in its folder can
    /// lead these astray.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn start_others(&mut self) -> Result<(), DockerError> {
        let others =
            self.containers.iter().filter(|(service, _)| service != WEBOTS).map(|(_, container)| container.as_str());
        let words: Vec<&str> = std::iter::once("start").chain(others).collect();
        if words.len() > 1 {
            self.docker.run(&words, SHORT).await?;
        }
        if let Some(controller) = self.of(CONTROLLER) {
            let asked = Arc::new(Notify::new());
            let restarts = restart_when_asked(self.docker.clone(), controller.to_owned(), Arc::clone(&asked));
            self.restart = Some((asked, AbortOnDropHandle::new(actix_rt::spawn(restarts))));
        }
        Ok(())
    }

    /// Asks to start the participant's controller anew, as the original does when Webots was reset.
    #[must_use]
    pub fn restart(&self) -> Option<Arc<Notify>> {
        self.restart.as_ref().map(|(asked, _)| Arc::clone(asked))
    }

    /// Why Webots' container has ended with this exit code, if Docker knows more than that.
    pub async fn cause(&self, code: Option<i32>) -> Option<Cause> {
        let webots = self.of(WEBOTS)?;
        match self.docker.run(&["inspect", "--format", "{{.State.OOMKilled}}", webots], SHORT).await {
            Ok(answer) if answer.trim() == "true" => Some(Cause::OutOfMemory),
            // The container may be known to it while it stops.
            Ok(_) if code != Some(TERMINATED) => None,
            Ok(_) | Err(DockerError::NoDaemon(_)) => Some(Cause::Docker),
            Err(_) => None,
        }
    }

    /// Removes everything of this simulation.
    pub async fn remove(self) {
        if let Err(error) = objects::remove(&self.docker, &self.lease.name).await {
            log::warn!("{} is not removed yet: {error}", self.lease.name);
        }
    }
}

/// Starts a container anew whenever that is asked for, one time after the other.
async fn restart_when_asked(docker: Docker, container: String, asked: Arc<Notify>) {
    loop {
        asked.notified().await;
        if let Err(error) = docker.run(&["restart", "--time", "0", &container], SHORT).await {
            log::warn!("a participant's controller is not started anew: {error}");
        }
        actix_rt::time::sleep(BETWEEN_RESTARTS).await;
    }
}
