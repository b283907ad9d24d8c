//! Runs git: without a shell, without prompts and hooks, with one protocol, and ended with whoever waits for it.

use std::ffi::{OsStr, OsString};
use std::io::PipeReader;
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::FutureExt;
use rustix::process::{Pid, Resource, Rlimit, prlimit, setpriority_process};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::unix::pipe::Receiver;

use super::git_error::GitError;
use crate::simulation::process::{ExitReason, Lines, ProcessGroup, SpawnSpec};

/// How git is run by this server.
#[derive(Debug)]
pub struct Git {
    /// The file with its settings, and what belongs into it.
    settings: (PathBuf, String),
    mark: PathBuf,
}

/// One git command.
#[derive(Debug, Clone)]
pub struct Call<'call> {
    /// The bare repository it works on.
    pub repository: &'call Path,
    /// Settings that it needs, each as `name=value`.
    pub settings: Vec<String>,
    /// The command and its arguments.
    pub arguments: Vec<OsString>,
    /// The one protocol that it may use.
    pub protocol: &'static str,
    /// How much memory it may take, in bytes, without the files that it maps.
    pub memory: u64,
    /// Further variables.
    pub environment: Vec<(OsString, OsString)>,
}

/// git reads this in place of the settings of the user as whom the server runs, for a world's program could have written
/// those. What the administrator has set for the machine, or in the file that `gitConfig` names, holds where this says
/// nothing else. Any repository may be read: a mirror may belong to somebody else, and nothing that it holds is run.
/// Redirects are not followed: they could lead to a repository, or into a network, that the configuration forbids.
const SETTINGS: &str = "\
[safe]
	directory = *
[core]
	hooksPath = /dev/null
	fsmonitor = false
	packedGitLimit = 512m
	packedGitWindowSize = 32m
	bigFileThreshold = 16m
[http]
	followRedirects = false
[filter \"lfs\"]
	process =
	smudge =
	required = false
[fetch]
	recurseSubmodules = false
	unpackLimit = 1
[submodule]
	recurse = false
[gc]
	autoDetach = false
[maintenance]
	auto = false
[init]
	defaultRefFormat = files
	templateDir =
[advice]
	detachedHead = false
";

/// How much memory a git process may take at most.
pub const MOST_MEMORY: u64 = 2 << 30;
/// The commands that may keep all cores busy for long: simulations that run already come before them.
const HEAVY: [&str; 2] = ["fetch", "gc"];
/// How much less priority these have, as `nice` has it.
const NICENESS: i32 = 10;
/// The most that is read of a command's answer, in bytes.
const LARGEST_ANSWER: usize = 64 * 1024 * 1024;
/// The most that is kept of a line of what it says besides, in bytes.
const LONGEST_LINE: usize = 500;

impl Git {
    /// Prepares git for the server whose run has this folder. `config` is the administrator's file of settings.
    #[must_use]
    pub fn new(run: &Path, config: Option<&Path>) -> Self {
        let config = config.map(|file| std::path::absolute(file).unwrap_or_else(|_| file.to_owned()));
        let quoted = |file: PathBuf| file.to_string_lossy().replace('\\', "\\\\").replace('"', "\\\"");
        let include = config.map(|file| format!("[include]\n\tpath = \"{}\"\n", quoted(file)));
        let settings = (run.join("gitconfig"), include.unwrap_or_default() + SETTINGS);
        Self { settings, mark: run.to_owned() }
    }

    /// Writes the settings, unless they are there as they should be.
    async fn write_settings(&self) -> std::io::Result<()> {
        let (file, text) = self.settings.clone();
        let write = move || {
            if std::fs::read(&file).is_ok_and(|found| found == text.as_bytes()) {
                return Ok(());
            }
            if let Some(folder) = file.parent() {
                std::fs::create_dir_all(folder)?;
            }
            std::fs::write(&file, text)
        };
        actix_rt::task::spawn_blocking(write).await?
    }

    /// Runs a command to its end. Returns its answer. `progress` hears each line of progress.
    ///
    /// Dropping the future ends git and all that it has started.
    ///
    /// # Errors
    /// When git can't be started or fails.
    pub async fn run(&self, call: Call<'_>, progress: impl FnMut(&str)) -> Result<Vec<u8>, GitError> {
        self.run_until(std::future::pending(), call, progress).await
    }

    /// The same, but a git that takes longer is killed, and nothing is returned: it was stopped, or its disk hangs.
    pub async fn run_within(&self, time: Duration, call: Call<'_>) -> Option<Result<Vec<u8>, GitError>> {
        let mut is_over = false;
        let end = async {
            actix_rt::time::sleep(time).await;
            is_over = true;
        };
        let done = self.run_until(end, call, |_| ()).await;
        (!is_over || done.is_ok()).then_some(done)
    }

    /// The same as [`Self::run`], but git is killed when `end` comes. Returns only when nothing of git is left.
    ///
    /// # Errors
    /// When git can't be started, fails or is killed.
    pub async fn run_until(
        &self,
        end: impl Future<Output = ()>,
        call: Call<'_>,
        progress: impl FnMut(&str),
    ) -> Result<Vec<u8>, GitError> {
        let command = call.arguments.iter().find(|argument| !argument.as_encoded_bytes().starts_with(b"-"));
        let command = command.map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let broken = |error: std::io::Error| GitError::NotStarted(error.to_string());
        self.write_settings().await.map_err(broken)?;
        let (answer, output) = std::io::pipe().map_err(broken)?;
        let (complaints, errors) = std::io::pipe().map_err(broken)?;
        let (memory, is_heavy, spec) = (call.memory, HEAVY.contains(&command.as_str()), self.spec(call));
        // A thread that starts a process waits until it runs its program, which takes long on a busy machine.
        let start = move || {
            let (group, ended) = ProcessGroup::start(&spec, output.into(), errors.into())?;
            bound(group.leader(), memory, is_heavy);
            Ok((group, ended.boxed()))
        };
        let started: std::io::Result<_> =
            actix_rt::task::spawn_blocking(start).await.map_err(|error| broken(error.into()))?;
        let (group, mut ended) = started.map_err(broken)?;
        let answer = asynchronous(answer).map_err(broken)?;
        let complaints = asynchronous(complaints).map_err(broken)?;
        let ended = async move {
            tokio::select! {
                ending = &mut ended => return ending,
                () = end => drop(group),
            }
            ended.await
        };
        let (answer, message, ending) = tokio::join!(read_all(answer), follow(complaints, progress), ended);
        match ending {
            _ if answer.len() > LARGEST_ANSWER => Err(GitError::TooLong(command)),
            ExitReason::Code(0) => Ok(answer),
            ExitReason::NotStarted => Err(GitError::NotStarted(message)),
            ending => Err(GitError::Failed { command, ending, message }),
        }
    }

    fn spec(&self, call: Call<'_>) -> SpawnSpec {
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
        let fixed = fixed.into_iter().map(|(name, value)| (name.into(), value.into()));
        SpawnSpec {
            command,
            inherits: true,
            environment: fixed.chain(call.environment).collect(),
            in_sandbox: false,
            folder: None,
            mark: self.mark.clone(),
            grace: Duration::from_millis(100),
        }
    }
}

/// Bounds the memory of a git that has just been started, and gives it less priority if its work is heavy. What it starts
/// inherits both.
fn bound(leader: i32, memory: u64, is_heavy: bool) {
    let pid = Pid::from_raw(leader);
    let limit = Rlimit { current: Some(memory), maximum: Some(memory) };
    let nice = if is_heavy { setpriority_process(pid, NICENESS) } else { Ok(()) };
    if let Err(error) = nice.and(prlimit(pid, Resource::Data, limit).map(drop)) {
        log::warn!("git runs without its limits: {error}");
    }
}

fn asynchronous(pipe: PipeReader) -> std::io::Result<Receiver> {
    Receiver::from_owned_fd(pipe.into())
}

async fn read_all(pipe: Receiver) -> Vec<u8> {
    let mut answer = Vec::new();
    // A broken pipe is the end of the answer; whether that is right is told by how git ended.
    pipe.take(LARGEST_ANSWER as u64 + 1).read_to_end(&mut answer).await.ok();
    answer
}

/// Passes on each line that git prints, also those that it overwrites. Returns the one that names the cause of a failure.
async fn follow(mut pipe: impl AsyncRead + Unpin, mut progress: impl FnMut(&str)) -> String {
    let mut cause = String::new();
    // The first fatal line names the cause, else the first error; what follows only tells what came of it.
    let weight = |text: &str| if text.starts_with("fatal:") { 2 } else { u8::from(text.starts_with("error:")) };
    let mut told = |line: String| {
        progress(&line);
        if weight(&line) > weight(&cause) || weight(&cause) == 0 {
            cause = line;
        }
    };
    let mut lines = Lines::new(LONGEST_LINE);
    let mut chunk = [0; 4096];
    while let Ok(length @ 1..) = pipe.read(&mut chunk).await {
        lines.feed(chunk.get(..length).unwrap_or_default(), &mut told);
    }
    lines.end(told);
    cause
}

#[cfg(test)]
mod tests {
    use super::*;

    #[actix_rt::test]
    async fn progress_is_told_line_by_line_and_the_cause_is_kept() {
        let text: &[u8] = b"remote: Counting\rremote: Counting done.\nReceiving objects:  10%\rfatal: no room\nfatal: index-pack failed\n";
        let mut lines = Vec::new();
        let last = follow(text, |line: &str| lines.push(line.to_owned())).await;
        assert_eq!(lines.len(), 5);
        assert_eq!(lines[2], "Receiving objects:  10%");
        assert_eq!(last, "fatal: no room");
        let text: &[u8] = b"error: no lock\nerror: no reference\nRemove the file by hand.\n";
        assert_eq!(follow(text, |_: &str| ()).await, "error: no lock");
        assert_eq!(follow(&b"one\ntwo\n"[..], |_: &str| ()).await, "two");
    }
}
