//! Starts the process of a Webots, on the machine or in containers, and waits until its whole process tree has ended.

use std::time::Duration;

use actix::prelude::*;

use super::launch_spec::LaunchSpec;
use super::output::{self, OutputEvent, Tail};
use crate::shared::run::{RotatedFile, seconds_since_1970};
use crate::simulation::container::{Cause, SimulationContainers};
use crate::simulation::ends::{EndReason, FOLDER_OF_RUNNING, Taken};
use crate::simulation::process::{ExitReason, ProcessGroup};
use crate::simulation::snapshot::Stage;

/// How a Webots has ended.
#[derive(Debug)]
pub struct End {
    /// The exit of its process.
    pub reason: ExitReason,
    /// The cause, if control groups or Docker report one.
    pub cause: Option<Cause>,
    /// The resources that it has used.
    pub taken: Taken,
}

/// Size from which the file of its output is rotated, in bytes.
const MAX_LOG: u64 = 500_000;
/// Timeout of reading the rest of an output.
const LAST_OUTPUT: Duration = Duration::from_secs(1);

/// Starts a Webots in these containers, or else on the machine. Returns its processes and the last lines of its output. The
/// future resolves when its whole process tree has ended.
///
/// # Errors
/// When a process, a thread or a directory can't be created.
pub fn launch(
    spec: &LaunchSpec,
    containers: Option<SimulationContainers>,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(ProcessGroup, Tail, impl Future<Output = End> + use<>)> {
    let folder = spec.config.log_dir.0.join("simulation").join(FOLDER_OF_RUNNING);
    let log = folder.join(format!("{}.log", spec.slot.lease.id()));
    let file = RotatedFile::open(&log, MAX_LOG, "").inspect_err(|error| {
        let why = format!(
            "what Webots prints is not kept: {} can't be written: {error}",
            log.display()
        );
        spec.slot.lease.log(log::Level::Warn, &why, &why);
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
    let pid = group.leader();
    spec.slot.lease.update(move |one| {
        (one.stage, one.launched) = (Stage::Launching, Some(seconds_since_1970()));
        (one.pid, one.log) = (Some(pid), log);
    });
    let ended = async move {
        let reason = ended.await;
        let mut in_container = None;
        if let Some(containers) = containers {
            in_container = containers.cause(reason).await;
            containers.remove().await;
        }
        // This also kills processes that have left the process group.
        let (on_machine, taken) = match cgroup {
            Some(cgroup) => actix_rt::task::spawn_blocking(move || cgroup.end())
                .await
                .unwrap_or_default(),
            None => (false, Taken::default()),
        };
        // The last output shows the cause. A process that can't be killed may keep the pipe open.
        actix_rt::time::timeout(LAST_OUTPUT, all_read).await.ok();
        End {
            reason,
            cause: in_container.or(on_machine.then_some(Cause::OutOfMemory)),
            taken,
        }
    };
    Ok((group, tail, ended))
}

impl End {
    /// The kind and the reason (as text) of an end that was not requested; `was_ready`: whether Webots had listened.
    pub fn verdict(&self, was_ready: bool) -> (EndReason, String) {
        let kind = match (self.cause, self.reason) {
            (Some(cause), _) if cause.is_own() => EndReason::Fault,
            (Some(_), _) => EndReason::Limit,
            (None, ExitReason::Code(0)) => EndReason::Finished,
            (None, _) if was_ready => EndReason::Crashed,
            (None, _) => EndReason::NoWebots,
        };
        let why = match self.cause {
            Some(cause) => words(cause).to_owned(),
            None => format!("Webots {}", self.reason),
        };
        (kind, why)
    }
}

/// The cause of a container's end, as text for the client.
fn words(cause: Cause) -> &'static str {
    match cause {
        Cause::OutOfMemory => "The simulation has taken more memory than it may (limits.memory)",
        Cause::NotStarted => "Docker can't start the simulation's container on this simulation server",
        Cause::Docker => "Docker has stopped on this simulation server, and all simulations in it have ended",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_end_has_its_kind() {
        let end = |reason, cause| End {
            reason,
            cause,
            taken: Taken::default(),
        };
        let (ok, killed) = (ExitReason::Code(0), ExitReason::Signal(9));
        for (end, was_ready, kind, words) in [
            (end(ok, None), true, EndReason::Finished, "Webots has ended"),
            (
                end(killed, None),
                true,
                EndReason::Crashed,
                "Webots was ended by the signal SIGKILL",
            ),
            (
                end(ExitReason::Code(3), None),
                false,
                EndReason::NoWebots,
                "Webots ended with exit code 3",
            ),
            (
                end(ExitReason::NotStarted, None),
                false,
                EndReason::NoWebots,
                "Webots could not be started",
            ),
            (
                end(killed, Some(Cause::OutOfMemory)),
                true,
                EndReason::Limit,
                super::words(Cause::OutOfMemory),
            ),
            (
                end(ok, Some(Cause::Docker)),
                true,
                EndReason::Fault,
                super::words(Cause::Docker),
            ),
        ] {
            assert_eq!(end.verdict(was_ready), (kind, words.to_owned()), "{end:?}");
        }
    }
}
