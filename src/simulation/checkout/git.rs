//! Runs git: without a shell, without prompts and hooks, with one protocol, and ended with whoever waits for it.

use std::ffi::{OsStr, OsString};
use std::io::PipeReader;
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::FutureExt;
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::unix::pipe::Receiver;
use which::which;

use crate::shared::run::one_line;
use crate::simulation::process::{ExitReason, ProcessGroup, SpawnSpec};

/// How git is run by this server.
#[derive(Debug)]
pub struct Git {
    settings: PathBuf,
    mark: PathBuf,
    has_nice: bool,
}

/// One git command.
#[derive(Debug)]
pub struct Call<'call> {
    /// The bare repository it works on.
    pub repository: &'call Path,
    /// The command and its arguments.
    pub arguments: Vec<OsString>,
    /// The one protocol that it may use.
    pub protocol: &'static str,
    /// Further variables.
    pub environment: Vec<(OsString, OsString)>,
}

/// A git command that failed.
#[derive(Debug, Clone, thiserror::Error)]
#[error("git {command} {ending}: {message}")]
pub struct GitError {
    /// Which one.
    pub command: String,
    /// How it ended.
    pub ending: String,
    /// What it said last.
    pub message: String,
}

impl GitError {
    /// Whether git has come to this end by itself: it could be started, and nobody has ended it.
    #[must_use]
    pub fn is_verdict(&self) -> bool {
        self.ending.starts_with("ended with")
    }

    /// Whether its answer was longer than what is read of one.
    #[must_use]
    pub fn is_endless(&self) -> bool {
        self.ending == ENDLESS
    }
}

/// git reads this in place of the settings of its user and machine. Any repository may be read: a mirror may belong
/// to somebody else, and nothing that it holds is run. Of a repository whose objects are borrowed, commits that have
/// come since must not be taken for known: whether they have all their ancestors is not known.
const SETTINGS: &str = "\
[safe]
	directory = *
[core]
	hooksPath = /dev/null
	fsmonitor = false
	alternateRefsPrefixes = refs/none/
[credential]
	helper =
[fetch]
	recurseSubmodules = false
	unpackLimit = 1
[submodule]
	recurse = false
[gc]
	auto = 0
	packRefs = false
[maintenance]
	auto = false
[init]
	defaultRefFormat = files
	templateDir =
[advice]
	detachedHead = false
";

/// The most that is read of a command's answer, in bytes.
const LARGEST_ANSWER: usize = 64 * 1024 * 1024;
/// How a command ends that answers more.
const ENDLESS: &str = "was ended";

impl Git {
    /// Prepares git for the server whose run has this folder.
    ///
    /// # Errors
    /// When its settings can't be written.
    pub fn new(run: &Path) -> std::io::Result<Self> {
        let settings = run.join("gitconfig");
        std::fs::write(&settings, SETTINGS)?;
        Ok(Self { settings, mark: run.to_owned(), has_nice: which("nice").is_ok() })
    }

    /// Runs a command to its end and gives back its answer. `progress` hears each line of progress.
    ///
    /// Dropping the future ends git and all that it has started.
    ///
    /// # Errors
    /// When git can't be started or fails.
    pub async fn run(&self, call: Call<'_>, progress: impl FnMut(&str)) -> Result<Vec<u8>, GitError> {
        self.run_until(std::future::pending(), call, progress).await
    }

    /// The same, but git is killed when `end` comes. It gives back only when nothing of git is left.
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
        let failed =
            |ending: &str, message: String| GitError { command: command.clone(), ending: ending.to_owned(), message };
        let broken = |error: std::io::Error| failed("can't be started", error.to_string());
        let (answer, output) = std::io::pipe().map_err(broken)?;
        let (complaints, errors) = std::io::pipe().map_err(broken)?;
        let (group, ended) = ProcessGroup::start(&self.spec(call), output.into(), errors.into()).map_err(broken)?;
        let mut ended = ended.boxed();
        let answer = asynchronous(answer).map_err(broken)?;
        let complaints = asynchronous(complaints).map_err(broken)?;
        let ended = async move {
            tokio::select! {
                ending = &mut ended => return ending,
                () = end => drop(group),
            }
            ended.await
        };
        let (answer, last_words, ending) = tokio::join!(read_all(answer), follow(complaints, progress), ended);
        match ending {
            _ if answer.len() > LARGEST_ANSWER => {
                Err(failed(ENDLESS, format!("its answer is longer than {} MiB", LARGEST_ANSWER >> 20)))
            }
            ExitReason::Code(0) => Ok(answer),
            ending => Err(failed(&ending.to_string(), last_words)),
        }
    }

    /// Whether everything is in order in a repository. It reads all of it: for use after a failure.
    pub async fn is_sound(&self, repository: &Path) -> bool {
        let arguments = ["fsck", "--full", "--no-dangling", "--no-progress"].map(OsString::from).to_vec();
        let call = Call { repository, arguments, protocol: "https", environment: Vec::new() };
        match self.run(call, |_| ()).await {
            Ok(_) => true,
            // A machine that can't run git says nothing of the repository.
            Err(error) => !error.is_verdict(),
        }
    }

    fn spec(&self, call: Call<'_>) -> SpawnSpec {
        // Whoever watches over the servers, and whoever runs a simulation already, comes before a checkout.
        let mut command: Vec<OsString> = ["nice", "git", "--literal-pathspecs", "--git-dir"].map(OsString::from).into();
        if !self.has_nice {
            command.remove(0);
        }
        command.push(call.repository.into());
        command.extend(call.arguments);
        let fixed: [(&str, &OsStr); 7] = [
            ("GIT_CONFIG_GLOBAL", self.settings.as_os_str()),
            ("GIT_CONFIG_NOSYSTEM", OsStr::new("1")),
            ("GIT_ALLOW_PROTOCOL", OsStr::new(call.protocol)),
            ("GIT_TERMINAL_PROMPT", OsStr::new("0")),
            ("GIT_ASKPASS", OsStr::new("/bin/false")),
            ("GIT_NO_REPLACE_OBJECTS", OsStr::new("1")),
            ("LC_ALL", OsStr::new("C")),
        ];
        let fixed = fixed.into_iter().map(|(name, value)| (name.into(), value.into()));
        SpawnSpec {
            command,
            environment: fixed.chain(call.environment).collect(),
            folder: None,
            mark: self.mark.clone(),
            grace: Duration::from_millis(100),
        }
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

/// Hands on each line that git prints, also those that it overwrites, and keeps the last that tells of a fault.
async fn follow(mut pipe: impl AsyncRead + Unpin, mut progress: impl FnMut(&str)) -> String {
    let mut last_words = String::new();
    let mut line = Vec::new();
    let mut chunk = [0; 4096];
    while let Ok(length @ 1..) = pipe.read(&mut chunk).await {
        for byte in chunk.iter().take(length) {
            match byte {
                b'\r' | b'\n' => {
                    finish(&mut line, &mut last_words, &mut progress);
                }
                _ if line.len() < 500 => line.push(*byte),
                _ => {}
            }
        }
    }
    finish(&mut line, &mut last_words, &mut progress);
    last_words
}

fn finish(line: &mut Vec<u8>, last_words: &mut String, progress: &mut impl FnMut(&str)) {
    let text = one_line(String::from_utf8_lossy(line).trim());
    line.clear();
    if text.is_empty() {
        return;
    }
    progress(&text);
    // The first fatal line names the cause; those that follow it only tell what came of it.
    if !last_words.starts_with("fatal:") {
        *last_words = text;
    }
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
    }
}
