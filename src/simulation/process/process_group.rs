//! A program that the server has started, and the process group that it leads.
//!
//! The crates for this (process-wrap, command-group) kill only the leader on drop, and have no grace period; all that
//! they would save is the call of `killpg`.

use std::ffi::OsString;
use std::fmt;
use std::future::Future;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use nix::errno::Errno;
use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use tokio::process::{Child, Command};
use tokio::sync::oneshot;

use super::process_tree;

/// How to start and how to end a program.
pub struct SpawnSpec {
    /// The program and its arguments, without a shell.
    pub command: Vec<OsString>,
    /// Whether it inherits the server's environment.
    pub inherits: bool,
    /// Environment variables, which replace the server's or add to them (see `inherits`).
    pub environment: Vec<(OsString, OsString)>,
    /// Number of wrappers around the program, each the parent of the next one: pasta if used, then bubblewrap. What
    /// bubblewrap starts leads a group of its own, and ends with each wrapper.
    pub wrappers: usize,
    /// Working directory; `None` for the server's own.
    pub folder: Option<PathBuf>,
    /// The directory that marks all processes of the tree, see [`process_tree::MARK`].
    pub mark: PathBuf,
    /// Time between SIGTERM and SIGKILL.
    pub grace: Duration,
}

impl SpawnSpec {
    /// A program of the server's own, in its environment and working directory, without a grace period.
    pub fn new(command: Vec<OsString>, mark: &Path) -> Self {
        Self {
            command,
            inherits: true,
            environment: Vec::new(),
            wrappers: 0,
            folder: None,
            mark: mark.to_owned(),
            grace: Duration::ZERO,
        }
    }
}

/// A running process group. Dropping it has the future of [`ProcessGroup::start`] kill the group at once.
pub struct ProcessGroup {
    leader: i32,
    terminate: Option<oneshot::Sender<()>>,
}

/// How a program ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExitReason {
    /// With this exit code.
    Code(i32),
    /// By this signal.
    Signal(i32),
    /// It could not be started: a launcher did not find it.
    NotStarted,
}

/// What has ended a program, if the kernel or Docker tells it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The kernel, because the program has reached its memory limit.
    MemoryLimit,
    /// The kernel, because the machine, or the whole server, had no memory left.
    OutOfMemory,
    /// Docker, which was stopped or has crashed.
    Docker,
    /// Docker, which could not start it although the project has defined no image.
    NotStarted,
}

/// Exit code of a launcher (a shell, `env`, `nice`) that does not find its program.
const NOT_FOUND: i32 = 127;
/// Offset that bubblewrap adds to the number of the signal that has ended its program.
const SIGNALLED: i32 = 128;
/// Time for killed processes to exit.
const VANISH: Duration = Duration::from_secs(1);
/// Interval between two checks whether the group is empty.
const POLL: Duration = Duration::from_millis(5);

impl ProcessGroup {
    /// Starts a program as the leader of a new group. The future resolves when the program has exited and the rest of
    /// its group is killed; dropping the future kills the group too.
    ///
    /// # Errors
    /// When the program does not exist, or the system can start no more processes.
    pub fn start(
        spec: &SpawnSpec,
        output: Stdio,
        errors: Stdio,
    ) -> std::io::Result<(Self, impl Future<Output = ExitReason> + Send + use<>)> {
        let (program, arguments) = spec.command.split_first().ok_or(std::io::ErrorKind::InvalidInput)?;
        let mut command = Command::new(program);
        if !spec.inherits {
            command.env_clear();
        }
        command
            .args(arguments)
            .envs(spec.environment.iter().map(|(name, value)| (name, value)));
        command.env(process_tree::MARK, &spec.mark).process_group(0);
        if let Some(folder) = &spec.folder {
            command.current_dir(folder);
        }
        let child = command.stdin(Stdio::null()).stdout(output).stderr(errors).spawn()?;
        let leader = child
            .id()
            .and_then(|id| i32::try_from(id).ok())
            .ok_or(std::io::ErrorKind::Other)?;
        let (terminate, asked) = oneshot::channel();
        let group = KillOnDrop {
            leader: Pid::from_raw(leader),
            wrappers: spec.wrappers,
        };
        let ended = wait(group, child, asked, spec.grace);
        Ok((
            Self {
                leader,
                terminate: Some(terminate),
            },
            ended,
        ))
    }

    /// The process id of the program, which is the number of the group.
    pub fn leader(&self) -> i32 {
        self.leader
    }

    /// Requests an orderly end: SIGTERM, the grace period, SIGKILL.
    pub fn terminate(&mut self) {
        if let Some(terminate) = self.terminate.take() {
            // The group may have ended already.
            terminate.send(()).ok();
        }
    }
}

/// Waits for the end of a program. `asked` receives the request for an orderly end; if its sender is dropped without
/// one, the group is killed at once.
async fn wait(group: KillOnDrop, mut child: Child, asked: oneshot::Receiver<()>, grace: Duration) -> ExitReason {
    let status = tokio::select! {
        status = child.wait() => status,
        asked = asked => {
            if asked.is_ok() {
                group.ask_to_end();
                // A launcher may exit before its child.
                let end = async {
                    child.wait().await.ok();
                    group.emptied().await;
                };
                actix_rt::time::timeout(grace, end).await.ok();
            }
            group.signal(Signal::SIGKILL);
            child.wait().await
        }
    };
    group.signal(Signal::SIGKILL);
    actix_rt::time::timeout(VANISH, group.emptied()).await.ok();
    // The system always reports how a child has ended.
    let reason = ExitReason::of(status.unwrap_or_default(), group.wrappers > 0);
    // The id of an empty group may be reused.
    std::mem::forget(group);
    reason
}

/// Kills a process group when it is dropped.
struct KillOnDrop {
    leader: Pid,
    wrappers: usize,
}

impl KillOnDrop {
    fn signal(&self, signal: Signal) {
        // The only possible error is that the group is empty, as intended.
        killpg(self.leader, signal).ok();
    }

    /// Sends SIGTERM to the program inside the wrappers. The wrappers must not get it: they would end at once, and kill
    /// everything inside.
    fn ask_to_end(&self) {
        let mut inside = vec![self.leader.as_raw()];
        for _ in 0..self.wrappers {
            inside = inside.into_iter().flat_map(process_tree::children).collect();
        }
        for leader in inside {
            // The only possible error is that its group is empty, as intended.
            killpg(Pid::from_raw(leader), Signal::SIGTERM).ok();
        }
    }

    /// Waits until the group is empty.
    async fn emptied(&self) {
        while killpg(self.leader, None) != Err(Errno::ESRCH) {
            actix_rt::time::sleep(POLL).await;
        }
    }
}

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        self.signal(Signal::SIGKILL);
    }
}

impl ExitReason {
    /// How a program ended. bubblewrap reports a signal as shells do: 128 plus its number.
    fn of(status: ExitStatus, in_sandbox: bool) -> Self {
        match (status.signal(), status.code().unwrap_or_default()) {
            (Some(signal), _) => Self::Signal(signal),
            (None, NOT_FOUND) => Self::NotStarted,
            (None, code) if in_sandbox && Signal::try_from(code - SIGNALLED).is_ok() => Self::Signal(code - SIGNALLED),
            (None, code) => Self::Code(code),
        }
    }
}

impl fmt::Display for ExitReason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(0) => out.write_str("has ended"),
            Self::Code(code) => write!(out, "ended with exit code {code}"),
            Self::NotStarted => out.write_str("could not be started"),
            Self::Signal(number) => {
                let name = Signal::try_from(*number).map_or("of an unknown name", Signal::as_str);
                write!(out, "was ended by the signal {name}")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_signal_is_told_as_one() {
        let reason = |raw| ExitReason::of(ExitStatus::from_raw(raw), false);
        assert_eq!(
            reason(129 << 8),
            ExitReason::Code(129),
            "git's wrong usage is no SIGHUP"
        );
        assert_eq!(reason(127 << 8), ExitReason::NotStarted);
        assert_eq!(reason(9), ExitReason::Signal(9));
        assert_eq!(
            ExitReason::of(ExitStatus::from_raw(139 << 8), true),
            ExitReason::Signal(11)
        );
        assert_eq!(
            ExitReason::of(ExitStatus::from_raw(255 << 8), true),
            ExitReason::Code(255),
            "no signal has this number"
        );
    }

    fn shell(script: &str) -> SpawnSpec {
        let command = ["bash", "-c", script].map(OsString::from).to_vec();
        SpawnSpec {
            grace: Duration::from_secs(20),
            ..SpawnSpec::new(command, Path::new("/nowhere"))
        }
    }

    #[actix_rt::test]
    async fn what_a_launcher_has_launched_gets_the_grace_time_too() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("written");
        // The launcher exits at once, while its child still does its last work.
        let script = format!(
            "(trap 'sleep 0.2; echo done > {}; exit' TERM; sleep 1000 & wait) & wait",
            file.display()
        );
        let (reader, output) = std::io::pipe().unwrap();
        let script = format!("echo ready; {script}");
        let (mut group, ended) = ProcessGroup::start(&shell(&script), output.into(), Stdio::null()).unwrap();
        let mut line = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(reader), &mut line).unwrap();
        actix_rt::time::sleep(Duration::from_millis(100)).await;
        group.terminate();
        assert_eq!(ended.await, ExitReason::Signal(15));
        assert_eq!(std::fs::read_to_string(file).unwrap(), "done\n");
    }
}
