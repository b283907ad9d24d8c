//! Starts the process of a Webots, on the machine or in containers, and waits until its whole process tree has ended.

use std::path::PathBuf;
use std::time::Duration;

use actix::prelude::*;

use super::launch_spec::LaunchSpec;
use super::output::{self, OutputEvent, Tail};
use crate::shared::domain::{Failure, Reason};
use crate::shared::run::RotatedFile;
use crate::simulation::container::SimulationContainers;
use crate::simulation::ends::{FOLDER_OF_RUNNING, ResourceUsage};
use crate::simulation::process::{Cause, ExitReason, ProcessGroup};

/// How the processes of a Webots have ended.
#[derive(Debug)]
pub struct Exit {
    /// The exit of its process.
    pub status: ExitReason,
    /// The cause, if control groups or Docker report one.
    pub cause: Option<Cause>,
    /// The resources that it has used.
    pub taken: ResourceUsage,
}

/// A Webots that was launched.
pub struct LaunchedProcess {
    /// Its processes.
    pub group: ProcessGroup,
    /// The last lines of its output.
    pub tail: Tail,
    /// The file that its output is kept in, if it can be written.
    pub log: Option<PathBuf>,
}

/// How far a Webots has come. Until it listens, nothing of a world is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reached {
    /// It was started.
    Start,
    /// It has listened.
    Listening,
    /// It was ready.
    Ready,
}

/// Size from which the file of its output is rotated, in bytes.
const MAX_LOG: u64 = 500_000;
/// Timeout of reading the rest of an output.
const LAST_OUTPUT: Duration = Duration::from_secs(1);

/// Starts a Webots in these containers, or else on the machine. The future resolves when its whole process tree has
/// ended.
///
/// # Errors
/// When a process, a thread or a directory can't be created.
pub fn launch(
    spec: &LaunchSpec,
    containers: Option<SimulationContainers>,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(LaunchedProcess, impl Future<Output = Exit> + use<>)> {
    let folder = spec.config.records().join(FOLDER_OF_RUNNING);
    let log = folder.join(format!("{}.log", spec.slot.id()));
    let file = RotatedFile::open(&log, MAX_LOG, "").inspect_err(|error| {
        let why = format!(
            "what Webots prints is not kept: {} can't be written: {error}",
            log.display()
        );
        spec.slot.log(log::Level::Warn, &why, &why);
    });
    let log = file.is_ok().then_some(log);
    let (reader, output) = std::io::pipe()?;
    let (tail, all_read) = output::follow(reader, spec.config.limits.output << 10, file.ok(), events)?;
    let errors = output.try_clone()?;
    let (process, cgroup) = match &containers {
        Some(containers) => (containers.spawn_spec(spec.config.timing.grace), None),
        None => spec.spawn_spec()?,
    };
    let (group, ended) = ProcessGroup::start(&process, output.into(), errors.into())?;
    let ended = async move {
        let status = ended.await;
        let mut in_container = None;
        if let Some(containers) = containers {
            in_container = containers.cause(status).await;
            containers.remove().await;
        }
        // This also kills processes that have left the process group.
        let (on_machine, taken) = match cgroup {
            Some(cgroup) => actix_rt::task::spawn_blocking(move || cgroup.end())
                .await
                .unwrap_or_default(),
            None => Default::default(),
        };
        // The last output shows the cause. A process that can't be killed may keep the pipe open.
        actix_rt::time::timeout(LAST_OUTPUT, all_read).await.ok();
        Exit {
            status,
            cause: in_container.or(on_machine),
            taken,
        }
    };
    Ok((LaunchedProcess { group, tail, log }, ended))
}

impl Exit {
    /// Why a Webots that nobody has asked to end has ended, given how far it came.
    pub fn failure(&self, reached: Reached) -> Failure {
        if let Some(cause) = self.cause {
            return failure_of(cause);
        }
        let reason = match (self.status, reached) {
            (ExitReason::Code(0), Reached::Ready) => Reason::Finished,
            (_, Reached::Start) => Reason::LaunchFailed,
            (_, Reached::Listening) => Reason::LoadFailed,
            (_, Reached::Ready) => Reason::Crashed,
        };
        Failure::new(reason, format!("Webots {}", self.status))
    }
}

/// The cause that control groups or Docker report.
fn failure_of(cause: Cause) -> Failure {
    match cause {
        Cause::MemoryLimit => Failure::new(
            Reason::MemoryLimit,
            "The simulation has taken more memory than it may (limits.memory)",
        ),
        Cause::OutOfMemory => Failure::new(
            Reason::OutOfMemory,
            "The memory of the simulation server has run out, and the system has ended the simulation",
        ),
        Cause::NotStarted => Failure::new(
            Reason::LaunchFailed,
            "Docker can't start the simulation's container on this simulation server",
        ),
        Cause::Docker => Failure::new(
            Reason::DockerUnavailable,
            "Docker has stopped on this simulation server, and all simulations in it have ended",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_end_has_its_reason() {
        let ok = ExitReason::Code(0);
        let killed = ExitReason::Signal(9);
        for (status, cause, reached, reason, words) in [
            (ok, None, Reached::Ready, Reason::Finished, "Webots has ended"),
            (ok, None, Reached::Listening, Reason::LoadFailed, "Webots has ended"),
            (ok, None, Reached::Start, Reason::LaunchFailed, "Webots has ended"),
            (
                killed,
                None,
                Reached::Ready,
                Reason::Crashed,
                "Webots was ended by the signal SIGKILL",
            ),
            (
                ExitReason::Code(3),
                None,
                Reached::Listening,
                Reason::LoadFailed,
                "Webots ended with exit code 3",
            ),
            (
                ExitReason::Code(3),
                None,
                Reached::Start,
                Reason::LaunchFailed,
                "Webots ended with exit code 3",
            ),
            (
                ExitReason::NotStarted,
                None,
                Reached::Start,
                Reason::LaunchFailed,
                "Webots could not be started",
            ),
            (
                killed,
                Some(Cause::MemoryLimit),
                Reached::Start,
                Reason::MemoryLimit,
                "The simulation has taken more memory than it may (limits.memory)",
            ),
            (
                killed,
                Some(Cause::OutOfMemory),
                Reached::Start,
                Reason::OutOfMemory,
                "The memory of the simulation server has run out, and the system has ended the simulation",
            ),
            (
                ok,
                Some(Cause::Docker),
                Reached::Ready,
                Reason::DockerUnavailable,
                "Docker has stopped on this simulation server, and all simulations in it have ended",
            ),
        ] {
            let exit = Exit {
                status,
                cause,
                taken: ResourceUsage::default(),
            };
            assert_eq!(exit.failure(reached), Failure::new(reason, words), "{exit:?}");
        }
    }
}
