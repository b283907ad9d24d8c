//! A program that the server has started, with all that it starts: dropping it ends them.

use std::ffi::OsString;
use std::fmt;
use std::future::Future;
use std::io::{PipeWriter, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use tokio::sync::oneshot;

use super::guardian::NOT_STARTED;
use super::{orphans, process_tree};

/// What to start, and how it ends.
#[derive(Debug)]
pub struct Plan {
    /// The program and its arguments; no shell ever sees them.
    pub command: Vec<OsString>,
    /// Variables that are added to the server's own environment.
    pub environment: Vec<(OsString, OsString)>,
    /// Working folder; the server's own where absent.
    pub folder: Option<PathBuf>,
    /// By which every process of the tree is known, and what a later server sweeps.
    pub mark: PathBuf,
    /// Folder that is removed with the tree.
    pub remove: Option<PathBuf>,
    /// Time between SIGTERM and SIGKILL.
    pub grace: Duration,
}

/// A guard for a running program and all its descendants.
///
/// Dropping it closes the guardian's lifeline (see [`super::guardian`]): everything is killed at once, also when the
/// drop comes from a panic, and also when the server itself is killed. A guardian that does not do so in time, for
/// what it guards has stopped it, is ended by the server with the whole tree.
#[derive(Debug)]
pub struct ProcessGroup {
    lifeline: PipeWriter,
    guardian: i32,
    /// Used once, when it is asked to end.
    asked: Option<oneshot::Sender<()>>,
}

/// How long a guardian may take beyond the grace time, before the server does its work.
const GUARDIAN: Duration = Duration::from_secs(2);

/// How a program ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// With this exit code.
    Code(u8),
    /// By this signal.
    Signal(u8),
    /// It could not be started.
    NotStarted,
}

impl ProcessGroup {
    /// Starts a program; the future ends when nothing of its tree is left.
    ///
    /// # Errors
    /// When the system can start no more processes.
    pub fn start(
        plan: &Plan,
        output: Stdio,
        errors: Stdio,
    ) -> std::io::Result<(Self, impl Future<Output = Ending> + Send + 'static)> {
        let (reader, lifeline) = std::io::pipe()?;
        let mut command = tokio::process::Command::new("/proc/self/exe");
        command.arg0("simulation-server").arg("guard");
        command.args(["--grace", &plan.grace.as_millis().to_string()]);
        if let Some(folder) = &plan.remove {
            command.arg("--remove").arg(folder);
        }
        command.arg("--").args(&plan.command);
        command.envs(plan.environment.iter().map(|(name, value)| (name, value))).env(process_tree::MARK, &plan.mark);
        if let Some(folder) = &plan.folder {
            command.current_dir(folder);
        }
        let mut child = orphans::start(command.stdin(reader).stdout(output).stderr(errors))?;
        let guardian = child.id().and_then(|id| i32::try_from(id).ok()).unwrap_or_default();
        let (mark, grace) = (plan.mark.clone(), plan.grace);
        let (asked, order) = oneshot::channel();
        let overdue = async move {
            // Where nobody asked, the lifeline has ended: then no grace time is given.
            let grace = order.await.map_or(Duration::ZERO, |()| grace);
            actix_rt::time::sleep(grace + GUARDIAN).await;
        };
        let ended = async move {
            let status = tokio::select! {
                status = child.wait() => status,
                () = overdue => {
                    log::error!("the guardian {guardian} does not end what it guards, the server does");
                    actix_rt::task::spawn_blocking(move || process_tree::kill_tree(guardian)).await.ok();
                    child.wait().await
                }
            };
            match status {
                Ok(status) if status.signal().is_none() => Ending::of_guardian(status),
                // Somebody has killed the guardian: what it guarded is now the server's.
                _ => {
                    log::error!("the guardian {guardian} was killed, its processes are ended");
                    let end = move || {
                        orphans::end_all();
                        process_tree::kill_marked(&mark)
                    };
                    actix_rt::task::spawn_blocking(end).await.ok();
                    Ending::Signal(9)
                }
            }
        };
        Ok((Self { lifeline, guardian, asked: Some(asked) }, ended))
    }

    /// The process from which the whole tree descends.
    #[must_use]
    pub fn guardian(&self) -> i32 {
        self.guardian
    }

    /// Asks for an orderly end: SIGTERM, the grace time, SIGKILL.
    pub fn ask_to_end(&mut self) {
        if let Some(asked) = self.asked.take() {
            asked.send(()).ok();
        }
        // A guardian that no longer reads has nothing left to end.
        self.lifeline.write_all(b".").ok();
    }
}

/// Has a folder removed when the server ends, in whatever way: as soon as nobody holds what is given back.
///
/// # Errors
/// When the system can start no more processes.
pub fn remove_in_the_end(folder: &Path) -> std::io::Result<PipeWriter> {
    let (reader, lifeline) = std::io::pipe()?;
    let mut command = tokio::process::Command::new("/proc/self/exe");
    command.arg0("simulation-server").args(["guard", "--remove"]).arg(folder);
    orphans::start(command.stdin(reader).stdout(Stdio::null()).stderr(Stdio::null()))?;
    Ok(lifeline)
}

/// Starts a program that starts no other; dropping the future kills it, and so does the kernel when the server ends.
///
/// # Errors
/// When the system can start no more processes.
pub fn start_alone(
    plan: &Plan,
    output: Stdio,
    errors: Stdio,
) -> std::io::Result<impl Future<Output = Ending> + Send + 'static> {
    let mut command = tokio::process::Command::new("setpriv");
    command.args(["--pdeathsig", "KILL", "--"]).args(&plan.command);
    command.envs(plan.environment.iter().map(|(name, value)| (name, value))).env(process_tree::MARK, &plan.mark);
    command.stdin(Stdio::null()).stdout(output).stderr(errors).process_group(0).kill_on_drop(true);
    let mut child = orphans::start(&mut command)?;
    Ok(async move { child.wait().await.map_or(Ending::NotStarted, Ending::of_program) })
}

impl Ending {
    /// Of a program that the server has started itself: its exit codes are its own, also those above 128.
    fn of_program(status: ExitStatus) -> Self {
        let signal = status.signal().and_then(|number| u8::try_from(number).ok());
        match u8::try_from(status.code().unwrap_or_default()).unwrap_or_default() {
            _ if signal.is_some() => Self::Signal(signal.unwrap_or_default()),
            NOT_STARTED => Self::NotStarted,
            code => Self::Code(code),
        }
    }

    fn of_guardian(status: ExitStatus) -> Self {
        match u8::try_from(status.code().unwrap_or_default()).unwrap_or_default() {
            NOT_STARTED => Self::NotStarted,
            code if code > 128 => Self::Signal(code - 128),
            code => Self::Code(code),
        }
    }
}

impl fmt::Display for Ending {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(0) => out.write_str("ended"),
            Self::Code(code) => write!(out, "ended with exit code {code}"),
            Self::NotStarted => out.write_str("could not be started"),
            Self::Signal(number) => match nix::sys::signal::Signal::try_from(i32::from(*number)) {
                Ok(signal) => write!(out, "was ended by the signal {signal}"),
                Err(_) => write!(out, "was ended by signal {number}"),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_signal_is_told_as_one() {
        let ending = |raw| Ending::of_program(ExitStatus::from_raw(raw));
        assert_eq!(ending(129 << 8), Ending::Code(129), "git's wrong usage is no SIGHUP");
        assert_eq!(ending(127 << 8), Ending::NotStarted);
        assert_eq!(ending(9), Ending::Signal(9));
    }
}
