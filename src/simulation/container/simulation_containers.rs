//! The containers of one simulation: made, and ready to be started. Whoever drops them gives them up to be removed.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tokio::sync::Notify;
use tokio_util::task::AbortOnDropHandle;

use super::docker::{Docker, DockerError, SHORT};
use super::orphan_cleanup::ActiveProjects;
use super::owned_resources;
use super::start_error::{StartError, blame};
use crate::simulation::process::SpawnSpec;

/// The containers of one simulation.
#[derive(Debug)]
pub struct SimulationContainers {
    docker: Docker,
    lease: ProjectGuard,
    /// The container of each service.
    containers: Vec<(String, String)>,
    /// Whether the project has made an image of theirs, which may be why Docker can't start one.
    is_projects: bool,
    /// Texts that its client gets as they are.
    pub texts: Vec<String>,
    /// What its client should know.
    pub warnings: Vec<String>,
    /// Asks to start the participant's controller anew, where there is one.
    restart: Option<(Arc<Notify>, AbortOnDropHandle<()>)>,
}

/// The name of a compose project. As long as this lives, its containers are not taken for what somebody has left.
#[derive(Debug)]
pub struct ProjectGuard {
    /// The name.
    pub name: String,
    live: ActiveProjects,
}

/// What has ended a container.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The kernel, because it took more memory than it may.
    OutOfMemory,
    /// Docker, which was stopped or has crashed.
    Docker,
    /// Docker again, which could not start it, though no image is the project's.
    NotStarted,
}

/// The exit codes of a program that was ended by SIGTERM or SIGKILL, as Docker ends all when it is stopped.
const ENDED_BY_SIGNAL: [i32; 2] = [128 + 15, 128 + 9];
/// How long before now Docker is asked for the end of a container, and after now: it answers when that has passed.
const EVENTS: (Duration, Duration) = (Duration::from_mins(1), Duration::from_millis(100));
/// The time between two starts of a participant's controller, at least.
const BETWEEN_RESTARTS: Duration = Duration::from_secs(1);
/// The service of a participant's controller.
const CONTROLLER: &str = "controller";
/// The service of Webots.
const WEBOTS: &str = "webots";

impl Cause {
    /// Whether it is this server's fault, so that another one may take the client.
    #[must_use]
    pub fn is_own(self) -> bool {
        self != Self::OutOfMemory
    }
}

impl ProjectGuard {
    /// Takes a name.
    #[must_use]
    pub fn take(name: String, live: &ActiveProjects) -> Self {
        live.insert(&name);
        Self { name, live: live.clone() }
    }
}

impl Drop for ProjectGuard {
    fn drop(&mut self) {
        self.live.remove(&self.name);
    }
}

impl SimulationContainers {
    /// The containers of a project that was made: pairs of service and container. `is_projects` says whether the project has
    /// made an image of theirs.
    #[must_use]
    pub fn new(
        docker: Docker,
        lease: ProjectGuard,
        containers: Vec<(String, String)>,
        is_projects: bool,
        texts: Vec<String>,
        warnings: Vec<String>,
    ) -> Self {
        Self { docker, lease, containers, is_projects, texts, warnings, restart: None }
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
    /// When Docker fails, and whose fault it is.
    pub async fn start_others(&mut self) -> Result<(), StartError> {
        let others =
            self.containers.iter().filter(|(service, _)| service != WEBOTS).map(|(_, container)| container.as_str());
        let words: Vec<&str> = std::iter::once("start").chain(others).collect();
        if words.len() > 1 {
            self.docker.run(&words, SHORT).await.map_err(|error| blame(self.is_projects, error))?;
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

    /// The ids of its containers, which the kernel knows them by; none where Docker fails.
    pub fn ids(&self) -> impl Future<Output = Vec<String>> + use<> {
        let docker = self.docker.clone();
        let names = self.containers.iter().map(|(_, container)| container.clone());
        let words: Vec<String> =
            ["inspect", "--format", "{{.Id}}"].map(str::to_owned).into_iter().chain(names).collect();
        async move {
            let ids = docker.run(&words, SHORT).await.unwrap_or_default();
            ids.lines().map(|id| id.trim().to_owned()).collect()
        }
    }

    /// Why Webots' container has ended, given the exit code of the program `docker`; nothing if Docker knows no more.
    pub async fn cause(&self, code: Option<i32>) -> Option<Cause> {
        let (webots, code) = (self.of(WEBOTS)?, code?);
        let format = "{{.State.OOMKilled}} {{.State.Status}} {{.State.ExitCode}}";
        let state = match self.docker.run(&["inspect", "--format", format, webots], SHORT).await {
            Ok(state) => state,
            Err(DockerError::Failed { .. }) => return None,
            Err(_) => return Some(Cause::Docker),
        };
        match state.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["true", ..] => Some(Cause::OutOfMemory),
            [_, "created", _] => (!self.is_projects).then_some(Cause::NotStarted),
            // The program has lost its daemon.
            [_, _, ended] if *ended != code.to_string() => Some(Cause::Docker),
            _ if ENDED_BY_SIGNAL.contains(&code) => self.was_stopped(webots).await.then_some(Cause::Docker),
            _ => None,
        }
    }

    /// Whether Docker has ended a container, or has been started anew since its end. A daemon that has seen a container end
    /// by itself tells of that end alone.
    async fn was_stopped(&self, container: &str) -> bool {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let [since, until] = [now.saturating_sub(EVENTS.0), now + EVENTS.1]
            .map(|time| format!("{}.{:09}", time.as_secs(), time.subsec_nanos()));
        let container = format!("container={container}");
        let words = ["events", "--since", &since, "--until", &until, "--filter", &container, "--format", "{{.Action}}"];
        let seen = self.docker.run(&words, SHORT).await;
        seen.map_or(true, |seen| !seen.lines().any(|line| line == "die") || seen.lines().any(|line| line == "kill"))
    }

    /// Removes everything of this simulation.
    pub async fn remove(self) {
        if let Err(error) = owned_resources::remove(&self.docker, &self.lease.name).await {
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
