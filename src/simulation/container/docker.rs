//! Runs the programs `docker` and `docker compose`: without a shell, with a timeout. Dropping the future ends them.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use which::which;

use crate::shared::domain::{Failure, Reason};
use crate::simulation::process::{DiskRoom, ExitReason, Ran, Run, RunError, SpawnSpec};

/// The commands of Docker on this machine.
#[derive(Debug, Clone)]
pub struct Docker {
    /// `docker compose`, or `docker-compose` if only that is installed.
    pub compose: &'static [&'static str],
    /// The directory of this run of the server, which marks all processes.
    mark: PathBuf,
}

/// Why a Docker command failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DockerError {
    /// Docker is not installed, or the system can start no more processes.
    #[error("Docker can't be started: {0}")]
    NotStarted(String),
    /// It exceeded its timeout.
    #[error("Docker did not end `{command}` within {} seconds", limit.as_secs())]
    Slow {
        /// The command.
        command: String,
        /// The timeout.
        limit: Duration,
    },
    /// It failed. The exit codes of `docker` do not depend on the cause: see [`Docker::explain`].
    #[error("`{command}` failed: {output}")]
    Failed {
        /// The command.
        command: String,
        /// The last line that it has printed. It may be a text of the project.
        output: String,
        /// Its standard output: what a query has found, if it has not found all.
        found: String,
    },
}

/// Timeout of queries and of other short commands.
pub const SHORT_TIMEOUT: Duration = Duration::from_secs(30);
/// Timeout of the daemon's answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Prefixes of the lines after the reason: which containers were not started, and where to find help.
const AFTER_REASON: [&str; 3] = ["Error: failed to start containers", "See 'docker", "Run 'docker"];
impl Docker {
    /// Determines the commands of Docker. Blocks for some seconds at most.
    ///
    /// # Errors
    /// What is missing, as text for an administrator.
    pub fn find(mark: &Path) -> Result<Self, String> {
        which("docker")
            .map_err(|_| "docker is not there; on Debian and Ubuntu the package docker.io has it".to_owned())?;
        let compose: &[_] = if docker_output(&["compose", "version"], SHORT_TIMEOUT).is_ok() {
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

    /// The failure of a command: Docker does not answer at this moment, its disk has less than `reserve` MiB left, or else
    /// `otherwise`, with what the command has printed. What is printed decides nothing: a Dockerfile may print the message
    /// of a daemon that is not there.
    pub async fn explain(&self, error: DockerError, reserve: u64, otherwise: Failure) -> Failure {
        let fault = spawn_blocking(move || daemon_fault().or_else(|| docker_disk_fault(reserve)));
        let fault = fault.await.ok().flatten();
        fault.unwrap_or_else(|| match error {
            DockerError::NotStarted(_) => error.into(),
            DockerError::Slow { .. } => otherwise,
            DockerError::Failed { output, .. } => otherwise.with_output(output),
        })
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
    let name = name_of(&run.spec.command);
    let mut reason = String::new();
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
pub fn docker_output(arguments: &[&str], limit: Duration) -> Result<String, DockerError> {
    let command: Vec<OsString> = ["docker"].iter().chain(arguments).map(OsString::from).collect();
    let name = name_of(&command);
    let mut reason = String::new();
    let ran = Run::new(command, Path::new("/"), limit).run_blocking(|line| note(&mut reason, &line));
    result(name, ran, reason)
}

/// Why the daemon can't be used now. It is asked twice, because a busy one may answer once too late. Blocks for ten
/// seconds at most.
pub fn daemon_fault() -> Option<Failure> {
    let ask = || docker_output(&["version", "--format", "{{.Server.Version}}"], ANSWER_TIMEOUT);
    let error = ask().or_else(|_| ask()).err()?;
    Some(match error {
        DockerError::Failed { output, .. } => {
            unavailable("Docker does not answer on this simulation server".to_owned()).with_output(output)
        }
        error => error.into(),
    })
}

/// Why Docker can store nothing more: its disk has less than `reserve` MiB left. Blocks.
pub fn docker_disk_fault(reserve: u64) -> Option<Failure> {
    let left = DiskRoom::of(&data_folder()?).ok()?.shortage(reserve)?;
    let message = format!("This simulation server's disk of Docker is full: less than {left}");
    Some(Failure::new(Reason::DiskFull, message))
}

fn unavailable(why: String) -> Failure {
    Failure::new(Reason::DockerUnavailable, why)
}

/// The directory in which Docker keeps images and containers; `None` if it does not run on this machine. Cached after
/// the first answer; blocks for five seconds at most.
pub fn data_folder() -> Option<PathBuf> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    if std::env::var("DOCKER_HOST").is_ok_and(|host| !host.starts_with("unix:")) {
        return None;
    }
    if FOLDER.get().is_none() {
        let output = docker_output(&["info", "--format", "{{.DockerRootDir}}"], ANSWER_TIMEOUT).ok()?;
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

/// Keeps a printed line if it may be the reason of a failure: the last one.
fn note(reason: &mut String, line: &str) {
    let line = line.trim();
    if !line.is_empty() && !AFTER_REASON.iter().any(|begin| line.starts_with(begin)) {
        line.clone_into(reason);
    }
}

fn result(command: String, ran: Result<Ran, RunError>, output: String) -> Result<String, DockerError> {
    match ran {
        Ok(Ran { ending, answer }) => {
            let found = String::from_utf8_lossy(&answer).into_owned();
            match ending {
                ExitReason::Code(0) => Ok(found),
                // Also 127, as if `docker` were not there: a build ends with the code of the step that has failed.
                _ => Err(DockerError::Failed { command, output, found }),
            }
        }
        Err(RunError::Slow(limit)) => Err(DockerError::Slow { command, limit }),
        Err(error @ RunError::TooLong) => Err(DockerError::Failed {
            command,
            output: error.to_string(),
            found: String::new(),
        }),
        Err(error) => Err(DockerError::NotStarted(error.to_string())),
    }
}

impl DockerError {
    /// The failure of a command whose time does not depend on a project: `otherwise`, unless Docker was too slow.
    pub fn unless_slow(&self, otherwise: Failure) -> Failure {
        match self {
            Self::Slow { .. } => self.clone().into(),
            _ => otherwise,
        }
    }
}

/// The failure of a command that does not depend on a project.
impl From<DockerError> for Failure {
    fn from(error: DockerError) -> Self {
        match error {
            DockerError::Failed { command, output, .. } => {
                Self::new(Reason::DockerUnavailable, format!("`{command}` failed")).with_output(output)
            }
            error => unavailable(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_with_the_reason_is_kept() {
        let failure = |command: &str, printed: &str| {
            let mut reason = String::new();
            printed.lines().for_each(|line| note(&mut reason, line));
            let ran = Ran {
                ending: ExitReason::Code(1),
                answer: Vec::new(),
            };
            result(command.to_owned(), Ok(ran), reason).unwrap_err().to_string()
        };
        let words =
            "Error response from daemon: port is already allocated\nError: failed to start containers: one, two\n";
        assert_eq!(
            failure("docker start one", words),
            "`docker start one` failed: Error response from daemon: port is already allocated"
        );
    }
}
