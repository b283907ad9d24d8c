//! Runs git: without a shell, without prompts and hooks, with one protocol. Dropping the future ends git.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::process::Resource;

use super::git_error::GitError;
use crate::shared::config::ExpandedPath;
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{ExitReason, Ran, Run};

/// Runs git with this server's settings.
pub struct Git {
    /// The file with git's settings, and its text.
    settings: (PathBuf, String),
    mark: PathBuf,
}

/// One git command.
#[derive(Debug, Clone)]
pub struct Call<'call> {
    /// The bare repository.
    pub repository: &'call Path,
    /// Settings that it needs besides, each as `name=value`.
    pub settings: Vec<String>,
    /// The command and its arguments.
    pub arguments: Vec<OsString>,
    /// The one protocol that it may use.
    pub protocol: &'static str,
    /// Memory limit in bytes, without mapped files.
    pub memory: u64,
    /// Size limit of a written file, in bytes.
    pub file_size: Option<u64>,
    /// Timeout of the command.
    pub time: Duration,
    /// Additional environment variables.
    pub environment: Vec<(OsString, OsString)>,
    /// Whether its start may block the calling thread.
    pub may_block: bool,
}

/// git reads this instead of the settings of the server's user, because a world's program could have written those. The
/// settings of the system, and of the file that `gitConfig` names, apply unless this overrides them. Any repository may
/// be read: a mirror may belong to another user, and nothing in it is executed. Redirects are off: they could resolve
/// to a repository, or into a network, that the configuration forbids. A remote that stays silent for too long is given
/// up.
const SETTINGS: &str = include_str!("gitconfig");

/// Memory limit in bytes for an answer of a remote, which is enough for a million branches, or for a copy.
pub const LITTLE_MEMORY: u64 = 512 << 20;
/// Largest memory limit of a git process, in bytes.
pub const MAX_MEMORY: u64 = 2 << 30;
/// Commands that may keep all cores busy for long: running simulations have priority.
const HEAVY: [&str; 2] = ["fetch", "gc"];
/// The niceness of these commands.
const NICENESS: i32 = 10;
/// Size limit of a command's answer, in bytes.
const MAX_ANSWER: u64 = 64 * 1024 * 1024;
/// Longest line of standard error that is kept, in bytes.
const MAX_LINE: usize = 500;

impl Git {
    /// Prepares git for the server whose run has this folder.
    pub fn new(run: &Path, config: &SimulationConfig) -> Self {
        let include = config.git_config.as_ref().map(|ExpandedPath(file)| {
            let file = std::path::absolute(file).unwrap_or_else(|_| file.clone());
            let quoted = file.to_string_lossy().replace('\\', "\\\\").replace('"', "\\\"");
            format!("[include]\n\tpath = \"{quoted}\"\n")
        });
        let silence = stall_timeout(config).as_secs().max(1);
        let silence = format!("[http]\n\tlowSpeedLimit = 1\n\tlowSpeedTime = {silence}\n");
        let settings = (run.join("gitconfig"), include.unwrap_or_default() + SETTINGS + &silence);
        Self { settings, mark: run.to_owned() }
    }

    /// Writes the file of settings, unless it is there.
    fn write_settings(&self) -> std::io::Result<()> {
        let (file, text) = &self.settings;
        if std::fs::exists(file)? {
            return Ok(());
        }
        std::fs::create_dir_all(&self.mark)?;
        // Others that start at once never see half of it.
        let new = self.mark.join(format!("gitconfig-{:08x}", rand::random::<u32>()));
        std::fs::write(&new, text)?;
        std::fs::rename(&new, file)
    }

    /// Runs a command to its end. Returns its answer. `progress` receives each line of standard error.
    ///
    /// Dropping the future ends git and its child processes.
    ///
    /// # Errors
    /// When git can't be started, fails, or takes too long.
    pub async fn run(&self, call: Call<'_>, mut progress: impl FnMut(&str)) -> Result<Vec<u8>, GitError> {
        let command = call.arguments.iter().find(|argument| !argument.as_encoded_bytes().starts_with(b"-"));
        let command = command.map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        self.write_settings()?;
        let mut cause = String::new();
        let on_line = |line: String| {
            progress(&line);
            if weight(&line) > weight(&cause) || weight(&cause) == 0 {
                cause = line;
            }
        };
        match self.prepared(call, &command).run(on_line).await {
            Ok(Ran { ending: ExitReason::Code(0), answer }) => Ok(answer),
            Ok(Ran { ending: ExitReason::NotStarted, .. }) => Err(GitError::machine(cause)),
            Ok(Ran { ending, .. }) => Err(GitError::ended(&command, ending, &cause)),
            Err(error) => Err(GitError::not_ended(&command, &error)),
        }
    }

    fn prepared(&self, call: Call<'_>, name: &str) -> Run {
        let mut command: Vec<OsString> = ["git", "--literal-pathspecs", "--git-dir"].map(OsString::from).into();
        command.push(call.repository.into());
        command.extend(call.settings.into_iter().flat_map(|setting| ["-c".into(), setting.into()]));
        command.extend(call.arguments);
        let fixed: [(&str, &OsStr); 6] = [
            ("GIT_CONFIG_GLOBAL", self.settings.0.as_os_str()),
            ("GIT_ALLOW_PROTOCOL", OsStr::new(call.protocol)),
            ("GIT_TERMINAL_PROMPT", OsStr::new("0")),
            ("GIT_ASKPASS", OsStr::new("/bin/false")),
            ("GIT_NO_REPLACE_OBJECTS", OsStr::new("1")),
            ("LC_ALL", OsStr::new("C")),
        ];
        let mut run = Run::new(command, &self.mark, call.time);
        let fixed = fixed.into_iter().map(|(name, value)| (name.into(), value.into()));
        run.spec.environment = fixed.chain(call.environment).collect();
        (run.answer, run.line) = (MAX_ANSWER, MAX_LINE);
        run.may_block = call.may_block;
        run.niceness = if HEAVY.contains(&name) { NICENESS } else { 0 };
        run.limits.push((Resource::Data, call.memory));
        if let Some(size) = call.file_size {
            // A larger write ends git with SIGXFSZ, which must not leave a core dump.
            run.limits.extend([(Resource::Core, 0), (Resource::Fsize, size)]);
        }
        run
    }
}

/// How long a remote may be silent, and packing a cached repository hold a fetch up.
pub fn stall_timeout(config: &SimulationConfig) -> Duration {
    config.timing.checkout / 4
}

/// Ranks git's messages: the first fatal line names the cause, else the first error; later lines are consequences.
fn weight(line: &str) -> u8 {
    if line.starts_with("fatal:") { 2 } else { u8::from(line.starts_with("error:")) }
}
