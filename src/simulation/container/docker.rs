//! Runs the programs `docker` and `docker compose`: without a shell, with a timeout. Dropping the future ends them.

use std::ffi::{OsStr, OsString};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use tokio::task::JoinError;
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

/// Why the containers of a simulation could not be started, as text for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StartError {
    /// The project is the cause: no other server could start it.
    #[error("{0}")]
    Project(String),
    /// This server is the cause, its Docker or its disk: another one may accept the client.
    #[error("{0}")]
    Server(String),
}

/// Timeout of queries and of other short commands.
pub const SHORT_TIMEOUT: Duration = Duration::from_secs(30);
/// Timeout of the daemon's answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Prefixes of the lines after the reason: which containers were not started, and where to find help.
const AFTER_REASON: [&str; 3] = ["Error: failed to start containers", "See 'docker", "Run 'docker"];
/// Parts of messages, in lower case, which say that the daemon can't be reached.
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
        let compose: &[_] = if blocking(&["compose", "version"], SHORT_TIMEOUT).is_ok() {
            &["docker", "compose"]
        } else if which("docker-compose").is_ok() {
            &["docker-compose"]
        } else {
            return Err(
                "docker compose is not there; the package docker-compose or docker-compose-plugin has it".to_owned(),
            );
        };
        Ok(Self {
            compose,
            mark: mark.to_owned(),
        })
    }

    /// Runs `docker` with these arguments, and returns its standard output.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn run<A: AsRef<OsStr>>(&self, arguments: &[A], limit: Duration) -> Result<String, DockerError> {
        let arguments = arguments.iter().map(|word| word.as_ref().to_owned());
        let command: Vec<OsString> = std::iter::once("docker".into()).chain(arguments).collect();
        finish(Run::new(command, &self.mark, limit), |_| ()).await
    }

    /// Runs a program with its arguments. `on_line` receives each line that it prints.
    ///
    /// # Errors
    /// When it fails or takes longer than the limit.
    pub async fn follow(
        &self,
        command: Vec<OsString>,
        limit: Duration,
        on_line: impl FnMut(&str),
    ) -> Result<(), DockerError> {
        let spec = self.spec(command, Duration::ZERO);
        finish(
            Run {
                spec,
                answer: 0,
                ..Run::new([""], &self.mark, limit)
            },
            on_line,
        )
        .await
        .map(drop)
    }

    /// The specification of a client program of the daemon. Dropping its process group ends only that program.
    pub fn spec(&self, command: Vec<OsString>, grace: Duration) -> SpawnSpec {
        // The classic builder prints its steps, and can build on the server's own network; BuildKit can't.
        let environment = vec![
            ("DOCKER_BUILDKIT".into(), "0".into()),
            ("COMPOSE_ANSI".into(), "never".into()),
        ];
        SpawnSpec {
            environment,
            grace,
            ..SpawnSpec::new(command, &self.mark)
        }
    }
}

async fn finish(run: Run, mut on_line: impl FnMut(&str)) -> Result<String, DockerError> {
    let (name, mut reason) = (name_of(&run.spec.command), String::new());
    let line = |line: String| {
        on_line(&line);
        note(&mut reason, &line);
    };
    let ran = run.run(line).await;
    result(name, ran, reason)
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

/// Why the daemon can't be used now, as text for clients and administrators. Blocks for five seconds at most.
pub fn daemon_fault() -> Option<String> {
    blocking(&["version", "--format", "{{.Server.Version}}"], ANSWER_TIMEOUT)
        .err()
        .map(|error| error.to_string())
}

/// The directory in which Docker keeps images and containers; `None` if it does not run on this machine. Cached after
/// the first answer; blocks for five seconds at most.
pub fn data_folder() -> Option<PathBuf> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    if std::env::var("DOCKER_HOST").is_ok_and(|host| !host.starts_with("unix:")) {
        return None;
    }
    if FOLDER.get().is_none() {
        let output = blocking(&["info", "--format", "{{.DockerRootDir}}"], ANSWER_TIMEOUT).ok()?;
        let folder = Some(PathBuf::from(output.trim())).filter(|folder| folder.is_absolute() && folder.exists())?;
        // A concurrent check may have set it.
        FOLDER.set(folder).ok();
    }
    FOLDER.get().cloned()
}

/// The program and its subcommand.
fn name_of(command: &[OsString]) -> String {
    let words = command
        .iter()
        .take_while(|word| !word.as_encoded_bytes().starts_with(b"-"))
        .take(3);
    words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}

/// Keeps a printed line if it may be the reason of a failure: the last one, or the first one about a missing daemon.
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
        Ok(Ran {
            ending: ExitReason::Code(0),
            answer,
        }) => Ok(String::from_utf8_lossy(&answer).into_owned()),
        Ok(Ran {
            ending: ExitReason::NotStarted,
            ..
        }) => Err(not_started(format!("there is no {command}"))),
        Ok(_) if has_no_daemon(&reason) => Err(DockerError::Unavailable(format!(
            "Docker does not answer on this simulation server: {reason}"
        ))),
        Ok(_) => Err(DockerError::Failed {
            command,
            message: reason,
        }),
        Err(RunError::Slow(limit)) => Err(DockerError::Slow { command, limit }),
        Err(error @ RunError::TooLong) => Err(DockerError::Failed {
            command,
            message: error.to_string(),
        }),
        Err(error) => Err(not_started(error.to_string())),
    }
}

/// The cause if Docker fails with the containers of a simulation. `is_projects`: whether the project has defined
/// one of their images: then the project is the cause, unless the disk is full.
pub fn blame(is_projects: bool, error: DockerError) -> StartError {
    match &error {
        DockerError::Failed { message, .. } if is_projects && !is_disk_full(message) => {
            StartError::Project(error.to_string())
        }
        _ => error.into(),
    }
}

/// Whether Docker reports a full disk. Only the end of the message counts, because it may contain names of the project.
pub fn is_disk_full(message: &str) -> bool {
    message.ends_with("no space left on device")
}

impl From<String> for StartError {
    fn from(why: String) -> Self {
        Self::Project(why)
    }
}

impl From<DockerError> for StartError {
    fn from(error: DockerError) -> Self {
        Self::Server(error.to_string())
    }
}

impl From<io::Error> for StartError {
    fn from(error: io::Error) -> Self {
        Self::Server(format!("This simulation server can't write in its cache: {error}"))
    }
}

impl From<JoinError> for StartError {
    fn from(error: JoinError) -> Self {
        Self::Server(error.to_string())
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
            let ran = Ran {
                ending: ExitReason::Code(1),
                answer: Vec::new(),
            };
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
            error
                .to_string()
                .ends_with("failed: Error response from daemon: port is already allocated"),
            "{error}"
        );
    }

    #[test]
    fn a_failure_of_a_projects_image_is_the_projects_fault() {
        let failed = |message: &str| DockerError::Failed {
            command: "docker cp".to_owned(),
            message: message.to_owned(),
        };
        let is_own = |error| matches!(blame(true, error), StartError::Server(_));
        assert!(!is_own(failed("mknod /x: operation not permitted")));
        assert!(!is_own(failed("no space left on device: no such file")));
        assert!(is_own(failed("write /x: no space left on device")));
        assert!(is_own(DockerError::Unavailable("refused".to_owned())));
    }
}
