//! Runs the programs `docker` and `docker compose`: without a shell, with a timeout. Dropping the future ends them.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use which::which;

use crate::simulation::process::{ExitReason, Ran, Run, RunError, SpawnSpec};

/// The commands of Docker on this machine.
#[derive(Debug, Clone)]
pub struct Docker {
    /// `docker compose`, or `docker-compose` if only that is installed.
    pub compose: &'static [&'static str],
    /// The directory of this run of the server, which marks all processes.
    mark: PathBuf,
}

/// Why a Docker command failed. The messages are for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DockerError {
    /// Docker is not installed, its daemon does not answer, or the system can start no more processes.
    #[error("{0}")]
    Unavailable(String),
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
pub const SHORT_TIMEOUT: Duration = Duration::from_secs(30);
/// Timeout of the check which compose command exists.
const FIND_TIMEOUT: Duration = Duration::from_secs(10);
/// How lines begin that follow the reason: which containers were not started, and where to find help.
const AFTER_REASON: [&str; 3] = ["Error: failed to start containers", "See 'docker", "Run 'docker"];
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
        let compose: &[_] = if blocking(&["compose", "version"], FIND_TIMEOUT).is_ok() {
            &["docker", "compose"]
        } else if which("docker-compose").is_ok() {
            &["docker-compose"]
        } else {
            return Err(
                "docker compose is not there; the package docker-compose or docker-compose-plugin has it".to_owned()
            );
        };
        Ok(Self { compose, mark: mark.to_owned() })
    }

    /// Runs `docker` with these arguments, and returns its standard output.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn run<A: AsRef<OsStr>>(&self, arguments: &[A], limit: Duration) -> Result<String, DockerError> {
        let arguments = arguments.iter().map(|word| word.as_ref().to_owned());
        let command: Vec<OsString> = std::iter::once("docker".into()).chain(arguments).collect();
        let (name, mut reason) = (name_of(&command), String::new());
        let ran = Run::new(command, &self.mark, limit).run(|line| note(&mut reason, &line)).await;
        result(name, ran, reason)
    }

    /// Runs a program with its arguments and these variables. `on_line` receives each line that it prints.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn follow(
        &self,
        command: Vec<OsString>,
        variables: Vec<(&'static str, String)>,
        limit: Duration,
        mut on_line: impl FnMut(&str),
    ) -> Result<(), DockerError> {
        let (name, mut reason) = (name_of(&command), String::new());
        let spec = self.spec(command, Duration::ZERO);
        let mut run = Run { spec, answer: 0, ..Run::new([""], &self.mark, limit) };
        run.spec.environment.extend(variables.into_iter().map(|(name, value)| (name.into(), value.into())));
        let line = |line: String| {
            on_line(&line);
            note(&mut reason, &line);
        };
        let ran = run.run(line).await;
        result(name, ran, reason).map(drop)
    }

    /// The specification of a client program of the daemon. Dropping its process group ends only that program.
    pub fn spec(&self, command: Vec<OsString>, grace: Duration) -> SpawnSpec {
        // The classic builder prints its steps, and can build on the server's own network; BuildKit can't.
        let environment = vec![("DOCKER_BUILDKIT".into(), "0".into()), ("COMPOSE_ANSI".into(), "never".into())];
        SpawnSpec { environment, grace, ..SpawnSpec::new(command, &self.mark) }
    }
}

/// Runs `docker` with these arguments, and returns its standard output. Blocks.
///
/// # Errors
/// When it fails or takes longer than the limit.
pub fn blocking(arguments: &[&str], limit: Duration) -> Result<String, DockerError> {
    let command: Vec<OsString> = ["docker"].iter().chain(arguments).map(OsString::from).collect();
    let (name, mut reason) = (name_of(&command), String::new());
    let ran = Run::new(command, Path::new("/"), limit).blocking(|line| note(&mut reason, &line));
    result(name, ran, reason)
}

/// The program and its subcommand.
fn name_of(command: &[OsString]) -> String {
    let words = command.iter().take_while(|word| !word.as_encoded_bytes().starts_with(b"-")).take(3);
    words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}

/// Keeps a line that a command prints if it may be why that fails: the last one, or the one that tells of no daemon.
fn note(reason: &mut String, line: &str) {
    let line = line.trim();
    if !line.is_empty() && !AFTER_REASON.iter().any(|begin| line.starts_with(begin)) && !has_no_daemon(reason) {
        line.clone_into(reason);
    }
}

fn has_no_daemon(reason: &str) -> bool {
    let reason = reason.to_lowercase();
    NO_DAEMON.iter().any(|words| reason.contains(words))
}

fn result(command: String, ran: Result<Ran, RunError>, reason: String) -> Result<String, DockerError> {
    let not_started = |why: String| DockerError::Unavailable(format!("Docker can't be started: {why}"));
    match ran {
        Ok(Ran { ending: ExitReason::Code(0), answer }) => Ok(String::from_utf8_lossy(&answer).into_owned()),
        Ok(Ran { ending: ExitReason::NotStarted, .. }) => Err(not_started(format!("there is no {command}"))),
        Ok(_) if has_no_daemon(&reason) => {
            Err(DockerError::Unavailable(format!("Docker does not answer on this simulation server: {reason}")))
        }
        Ok(_) if reason.is_empty() => Err(DockerError::Failed { command, message: "it says nothing".to_owned() }),
        Ok(_) => Err(DockerError::Failed { command, message: reason }),
        Err(RunError::Slow(limit)) => Err(DockerError::Slow { command, limit }),
        Err(error @ RunError::TooLong) => Err(DockerError::Failed { command, message: error.to_string() }),
        Err(error) => Err(not_started(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_daemon_that_is_not_there_is_told_apart() {
        let failure = |command: &str, printed: &str| {
            let mut reason = String::new();
            printed.lines().for_each(|line| note(&mut reason, line));
            let ran = Ran { ending: ExitReason::Code(1), answer: Vec::new() };
            result(command.to_owned(), Ok(ran), reason).unwrap_err()
        };
        let words = "Couldn't connect to Docker daemon at unix:///x - is it running?\n\nIf it's elsewhere, say so.\n";
        assert!(matches!(failure("docker ps", words), DockerError::Unavailable(_)));
        let error = failure("docker build", "Step 1/2\nno space left on device\n");
        assert_eq!(error.to_string(), "`docker build` failed: no space left on device");
        let words =
            "Error response from daemon: port is already allocated\nError: failed to start containers: one, two\n";
        let error = failure("docker start one", words);
        assert!(
            error.to_string().ends_with("failed: Error response from daemon: port is already allocated"),
            "{error}"
        );
    }
}
