//! Runs git: without a shell, without prompts and hooks, with one protocol. Dropping the future ends git.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use nix::libc::SIGKILL;
use rustix::process::Resource;

use super::disk::spawn_blocking_io;
use super::http_trace::traced;
use crate::shared::config::ExpandedPath;
use crate::shared::domain::{Failure, Reason};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{ExitReason, Ran, Run, RunError, disk_fault, own_call_failed, start_fault};

/// Runs git with this server's settings.
pub struct Git {
    /// The file with git's settings, and its text.
    settings: (PathBuf, String),
    mark: PathBuf,
    /// The configuration.
    pub config: Arc<SimulationConfig>,
}

/// Why a git command has failed. The name of its repository comes before the messages.
#[derive(Debug)]
pub enum GitError {
    /// It was not run to its end, for this reason.
    NotRun(Failure),
    /// It has ended with another exit code than 0, or by a signal. git's exit codes do not depend on the cause.
    Ended(GitExit),
}

/// The end of a git command that has failed.
#[derive(Debug)]
pub struct GitExit {
    command: String,
    ending: ExitReason,
    /// The line about the cause.
    output: String,
}

impl GitExit {
    /// It as a failure for this reason.
    pub fn failure(self, reason: Reason) -> Failure {
        let Self {
            command,
            ending,
            output,
        } = self;
        Failure::new(reason, format!("can't be checked out: git {command} {ending}")).with_output(output)
    }
}

/// git reads this instead of the settings of the server's user, because a world's program could have written those. The
/// settings of the system, and of the file that `gitConfig` names, apply unless this overrides them. Any repository may
/// be read: a mirror may belong to another user, and nothing in it is executed. Redirects are off: they could resolve
/// to a repository, or into a network, that the configuration forbids. A remote that stays silent for too long is given
/// up.
const SETTINGS: &str = include_str!("gitconfig");

/// The last option before the command.
const GIT_DIR: &str = "--git-dir=";
/// The name of a directory that does not exist.
const NO_REPOSITORY: &str = "none";
/// Memory limit of a query of a remote (enough for a million branches) or a checkout, in bytes, without mapped files.
pub const LITTLE_MEMORY: u64 = 512 << 20;
/// Largest memory limit of a git process, in bytes.
const MAX_MEMORY: u64 = 2 << 30;
/// Commands that may keep all cores busy for long: running simulations have priority.
const HEAVY: [&str; 2] = ["fetch", "gc"];
/// The niceness of these commands.
const NICENESS: i32 = 10;
/// Size limit of a command's answer, in bytes.
const MAX_ANSWER: u64 = 64 * 1024 * 1024;

impl Git {
    /// Prepares git. `run` is the directory of this run of the server.
    pub fn new(run: &Path, config: Arc<SimulationConfig>) -> Self {
        let include = config.git_config.as_ref().map(|ExpandedPath(file)| {
            let file = std::path::absolute(file).unwrap_or_else(|_| file.clone());
            let quoted = file.to_string_lossy().replace('\\', "\\\\").replace('"', "\\\"");
            format!("[include]\n\tpath = \"{quoted}\"\n")
        });
        let silence = stall_timeout(&config).as_secs().max(1);
        let silence = format!("[http]\n\tlowSpeedLimit = 1\n\tlowSpeedTime = {silence}\n");
        let settings = (run.join("gitconfig"), include.unwrap_or_default() + SETTINGS + &silence);
        Self {
            settings,
            mark: run.to_owned(),
            config,
        }
    }

    /// Writes the file of settings, unless it exists.
    fn write_settings(&self) -> std::io::Result<()> {
        let (file, text) = &self.settings;
        if std::fs::exists(file)? {
            return Ok(());
        }
        std::fs::create_dir_all(&self.mark)?;
        // Concurrent git processes never see half of it.
        let new = self.mark.join(format!("gitconfig-{:08x}", rand::random::<u32>()));
        std::fs::write(&new, text)?;
        std::fs::rename(&new, file)
    }

    /// A command on a bare repository, with these settings, each as `name=value`. It may use one protocol only.
    pub fn command(
        &self,
        (repository, protocol): (&Path, &str),
        settings: &[String],
        arguments: &[impl AsRef<OsStr>],
    ) -> Run {
        let folder = [OsStr::new(GIT_DIR), repository.as_os_str()].join(OsStr::new(""));
        let settings = settings.iter().flat_map(|setting| ["-c".into(), setting.into()]);
        let words = ["git".into(), "--literal-pathspecs".into()]
            .into_iter()
            .chain(settings)
            .chain([folder]);
        let mut run = Run::new(
            words.chain(arguments.iter().map(OsString::from)),
            &self.mark,
            self.config.timing.checkout,
        );
        run.spec.environment = vec![
            ("GIT_CONFIG_GLOBAL".into(), self.settings.0.clone().into()),
            ("GIT_ALLOW_PROTOCOL".into(), protocol.into()),
            ("GIT_TERMINAL_PROMPT".into(), "0".into()),
            ("GIT_ASKPASS".into(), "/bin/false".into()),
            ("GIT_NO_REPLACE_OBJECTS".into(), "1".into()),
            ("LC_ALL".into(), "C".into()),
        ];
        run.answer = MAX_ANSWER;
        run.limits.push((Resource::Data, MAX_MEMORY));
        run
    }

    /// Runs a command to its end. Returns its answer. `progress` receives each line of standard error.
    ///
    /// Dropping the future ends git and its child processes.
    ///
    /// # Errors
    /// When git can't be started, fails, or takes too long.
    pub async fn run(&self, mut run: Run, mut progress: impl FnMut(&str)) -> Result<Vec<u8>, GitError> {
        let words = run.spec.command.iter().map(|word| word.to_string_lossy());
        let command = words
            .skip_while(|word| !word.starts_with(GIT_DIR))
            .nth(1)
            .unwrap_or_default()
            .into_owned();
        run.niceness = if HEAVY.contains(&command.as_str()) { NICENESS } else { 0 };
        self.write_settings()
            .map_err(|error| GitError::NotRun(not_started(&error.kind().to_string())))?;
        let mut output = String::new();
        let on_line = |line: String| {
            progress(&line);
            if traced(&line).is_none() && (weight(&line) > weight(&output) || weight(&output) == 0) {
                output = line;
            }
        };
        match run.run(on_line).await {
            Ok(Ran {
                ending: ExitReason::Code(0),
                answer,
            }) => Ok(answer),
            Ok(Ran {
                ending: ExitReason::NotStarted,
                ..
            }) => Err(GitError::NotRun(not_started("it is not there"))),
            Ok(Ran { ending, .. }) => {
                let exit = GitExit {
                    command,
                    ending,
                    output,
                };
                Err(match ending {
                    // Nothing that it reads does this. As a rule the kernel does, when memory has run out.
                    ExitReason::Signal(SIGKILL) => GitError::NotRun(exit.failure(Reason::ServerFault)),
                    _ => GitError::Ended(exit),
                })
            }
            Err(error) => Err(GitError::NotRun(not_run(&command, &error))),
        }
    }

    /// Why this server's git, or its disk, does not work at this moment; `None` if both do.
    pub async fn machine_fault(&self) -> Option<Failure> {
        let folder = self.mark.clone();
        let reserve = self.config.disk_reserve;
        let look = move || Ok(disk_fault(&folder, reserve).or_else(|| start_fault("git")));
        spawn_blocking_io(look)
            .await
            .unwrap_or_else(|error| Some(own_call_failed(&error)))
    }

    /// A command that only queries a remote. It has no repository, so that it works if the cached one is damaged.
    pub fn query(&self, protocol: &str, settings: &[String], arguments: &[impl AsRef<OsStr>]) -> Run {
        self.command((&self.mark.join(NO_REPOSITORY), protocol), settings, arguments)
    }

    /// An empty directory beside the cache, for a repository.
    ///
    /// # Errors
    /// When it can't be created.
    pub fn scratch(&self) -> std::io::Result<tempfile::TempDir> {
        std::fs::create_dir_all(&self.mark)?;
        tempfile::Builder::new().prefix("repository-").tempdir_in(&self.mark)
    }
}

/// Why a command has not ended by itself.
fn not_run(command: &str, error: &RunError) -> Failure {
    match error {
        RunError::NotStarted(error) => not_started(&error.kind().to_string()),
        RunError::Slow(limit) => timed_out(*limit),
        RunError::TooLong => Failure::new(
            Reason::ProjectTooLarge,
            format!("can't be checked out: git {command} has answered too much"),
        ),
    }
}

fn not_started(why: &str) -> Failure {
    let message = format!("can't be checked out: this simulation server can't start git: {why}");
    Failure::new(Reason::ServerFault, message)
}

/// A checkout, or a command of one, took longer than this. `Fetching` and the name of the repository come before.
pub fn timed_out(limit: Duration) -> Failure {
    let message = format!("took longer than {} seconds", limit.as_secs());
    Failure::new(Reason::CheckoutTimeout, message)
}

/// Timeout of a remote that sends nothing, and of packing a cached repository, for which the next fetch waits.
pub fn stall_timeout(config: &SimulationConfig) -> Duration {
    config.timing.checkout / 4
}

/// Ranks git's messages: the first fatal line names the cause, else the first error; later lines are consequences.
fn weight(line: &str) -> u8 {
    if line.starts_with("fatal:") {
        2
    } else {
        u8::from(line.starts_with("error:"))
    }
}
