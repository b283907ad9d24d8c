//! Runs git: without a shell, without prompts and hooks, with one protocol. Dropping the future ends git.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rustix::process::Resource;

use super::checkout_error::{Cause, CheckoutError};
use crate::shared::config::ExpandedPath;
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{ExitReason, Ran, Run};

/// Runs git with this server's settings.
pub struct Git {
    /// The file with git's settings, and its text.
    settings: (PathBuf, String),
    mark: PathBuf,
    /// The configuration.
    pub config: Arc<SimulationConfig>,
}

/// git reads this instead of the settings of the server's user, because a world's program could have written those. The
/// settings of the system, and of the file that `gitConfig` names, apply unless this overrides them. Any repository may
/// be read: a mirror may belong to another user, and nothing in it is executed. Redirects are off: they could resolve
/// to a repository, or into a network, that the configuration forbids. A remote that stays silent for too long is given
/// up.
const SETTINGS: &str = include_str!("gitconfig");

/// The last option before the command.
const GIT_DIR: &str = "--git-dir=";
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
    pub async fn run(&self, mut run: Run, mut progress: impl FnMut(&str)) -> Result<Vec<u8>, CheckoutError> {
        let words = run.spec.command.iter().map(|word| word.to_string_lossy());
        let command = words
            .skip_while(|word| !word.starts_with(GIT_DIR))
            .nth(1)
            .unwrap_or_default()
            .into_owned();
        run.niceness = if HEAVY.contains(&command.as_str()) { NICENESS } else { 0 };
        self.write_settings()?;
        let mut cause = String::new();
        let on_line = |line: String| {
            progress(&line);
            if weight(&line) > weight(&cause) || weight(&cause) == 0 {
                cause = line;
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
            }) => Err(CheckoutError::new(Cause::Machine, cause)),
            Ok(Ran { ending, .. }) => Err(CheckoutError::ended(&command, ending, &cause)),
            Err(error) => Err(CheckoutError::not_ended(&command, &error)),
        }
    }
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
