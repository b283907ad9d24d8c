//! Runs the programs `docker` and `docker compose`: without a shell, with a timeout. Dropping the future ends them.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use which::which;

use crate::simulation::process::{ExitReason, Run, RunError, SpawnSpec};

/// The commands of Docker on this machine.
#[derive(Debug, Clone)]
pub struct Docker {
    /// `docker compose`, or `docker-compose` if only that is installed.
    compose: Vec<OsString>,
    /// The directory of this run of the server, which marks all processes.
    mark: PathBuf,
}

/// Why a Docker command failed. The messages are for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DockerError {
    /// A program does not exist, or the system can start no more processes.
    #[error("Docker can't be started: {0}")]
    NotStarted(String),
    /// The daemon does not answer.
    #[error("Docker does not answer on this simulation server: {0}")]
    NoDaemon(String),
    /// It exceeded its timeout.
    #[error("Docker did not end `{command}` within {} seconds", limit.as_secs())]
    Slow {
        /// The command.
        command: String,
        /// The timeout.
        limit: Duration,
    },
    /// It failed.
    #[error("`{command}` failed: {message}")]
    Failed {
        /// The command.
        command: String,
        /// The line with the reason.
        message: String,
    },
}

/// Timeout of queries and of other short commands.
pub const SHORT: Duration = Duration::from_secs(30);
/// Timeout of the check which compose command exists.
const FIND: Duration = Duration::from_secs(10);
/// Size limit of the kept output, in bytes.
const LONGEST_OUTPUT: usize = 1 << 20;
/// How a line begins that says of which containers the lines before it are.
const LIST: &str = "Error: failed to start containers";
/// How a message begins that says that nobody listens.
const NO_DAEMON: [&str; 4] = [
    "cannot connect to the docker daemon",
    "couldn't connect to docker daemon",
    "error during connect",
    "permission denied while trying to connect",
];

impl Docker {
    /// Determines the commands of Docker. Blocks for some seconds at most.
    ///
    /// # Errors
    /// What is missing, as text for an administrator.
    pub fn find(mark: &Path) -> Result<Self, String> {
        which("docker")
            .map_err(|_| "docker is not there; on Debian and Ubuntu the package docker.io has it".to_owned())?;
        let plugin = Run::new(["docker", "compose", "version"], mark, FIND).blocking(drop);
        let is_plugin = plugin.is_ok_and(|ran| ran.ending == ExitReason::Code(0));
        let compose: &[&str] = if is_plugin {
            &["docker", "compose"]
        } else if which("docker-compose").is_ok() {
            &["docker-compose"]
        } else {
            return Err(
                "docker compose is not there; the package docker-compose or docker-compose-plugin has it".to_owned()
            );
        };
        Ok(Self { compose: compose.iter().map(OsString::from).collect(), mark: mark.to_owned() })
    }

    /// Runs `docker` with these arguments, and returns what it prints.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn run<A: AsRef<OsStr>>(&self, arguments: &[A], limit: Duration) -> Result<String, DockerError> {
        let arguments = arguments.iter().map(|word| word.as_ref().to_owned());
        let command = std::iter::once("docker".into()).chain(arguments).collect();
        self.call(command, Vec::new(), limit, |_| ()).await
    }

    /// The same, but `told` receives each line that it prints.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn follow(
        &self,
        arguments: Vec<OsString>,
        limit: Duration,
        told: impl FnMut(&str),
    ) -> Result<(), DockerError> {
        let command = std::iter::once("docker".into()).chain(arguments).collect();
        self.call(command, Vec::new(), limit, told).await.map(drop)
    }

    /// Runs `docker compose` with these arguments and variables.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn compose(
        &self,
        arguments: Vec<OsString>,
        variables: Vec<(&'static str, String)>,
        limit: Duration,
    ) -> Result<(), DockerError> {
        self.call(self.compose.iter().cloned().chain(arguments).collect(), variables, limit, |_| ()).await.map(drop)
    }

    /// The specification of a client program of the daemon. Dropping its process group ends only that program.
    #[must_use]
    pub fn spec(&self, command: Vec<OsString>, grace: Duration) -> SpawnSpec {
        // The classic builder prints its steps, and can build on the server's own network; BuildKit can't.
        let environment = vec![("DOCKER_BUILDKIT".into(), "0".into()), ("COMPOSE_ANSI".into(), "never".into())];
        SpawnSpec { environment, grace, ..SpawnSpec::new(command, &self.mark) }
    }

    async fn call(
        &self,
        command: Vec<OsString>,
        variables: Vec<(&'static str, String)>,
        limit: Duration,
        mut told: impl FnMut(&str),
    ) -> Result<String, DockerError> {
        let name: Vec<_> =
            command.iter().take_while(|word| !word.as_encoded_bytes().starts_with(b"-")).take(3).collect();
        let name = name.iter().map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ");
        let mut run = Run::new([""], &self.mark, limit);
        run.spec = self.spec(command, Duration::ZERO);
        run.spec.environment.extend(variables.into_iter().map(|(name, value)| (name.into(), value.into())));
        let mut printed = String::new();
        let keep = |line: String| {
            told(&line);
            if printed.len() > LONGEST_OUTPUT {
                printed.clear();
            }
            printed.push_str(&line);
            printed.push('\n');
        };
        match run.follow(keep).await {
            Ok(ExitReason::Code(0)) => Ok(printed),
            Ok(ExitReason::NotStarted) => Err(DockerError::NotStarted(format!("there is no {name}"))),
            Ok(_) => Err(failure(name, &printed)),
            Err(RunError::Slow(_)) => Err(DockerError::Slow { command: name, limit }),
            Err(error) => Err(DockerError::NotStarted(error.to_string())),
        }
    }
}

/// What a failed command has printed, as an error. Its last line says what was wrong, but for the one in which `docker start`
/// lists the containers.
fn failure(command: String, printed: &str) -> DockerError {
    let mut lines = printed.lines().rev().map(str::trim);
    let message =
        lines.find(|line| !line.is_empty() && !line.starts_with(LIST)).unwrap_or("it says nothing").to_owned();
    let said = printed.to_lowercase();
    if NO_DAEMON.iter().any(|words| said.contains(words)) {
        return DockerError::NoDaemon(message);
    }
    DockerError::Failed { command, message }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_daemon_that_is_not_there_is_told_apart() {
        let words = "Cannot connect to the Docker daemon at unix:///x. Is the docker daemon running?\n";
        assert!(matches!(failure("docker ps".to_owned(), words), DockerError::NoDaemon(_)));
        let error = failure("docker build".to_owned(), "Step 1/2\nno space left on device\n");
        assert_eq!(error.to_string(), "`docker build` failed: no space left on device");
        let words =
            "Error response from daemon: port is already allocated\nError: failed to start containers: one, two\n";
        let error = failure("docker start one".to_owned(), words);
        assert!(
            error.to_string().ends_with("failed: Error response from daemon: port is already allocated"),
            "{error}"
        );
    }
}
