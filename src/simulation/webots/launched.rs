//! Starts the process of a Webots, and waits until its whole process tree has ended.

use std::future::Future;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;

use super::launch_spec::LaunchSpec;
use super::launch_target::LaunchTarget;
use super::output::{self, OutputEvent, Tail};
use crate::shared::run::RotatedFile;
use crate::simulation::container::Cause;
use crate::simulation::ends::Taken;
use crate::simulation::isolation::{Cgroup, Peak};
use crate::simulation::process::{ExitReason, ProcessGroup};

/// A Webots that was started.
pub struct Launched {
    /// Its processes.
    pub group: ProcessGroup,
    /// The directory of its control group, if it has one.
    pub cgroup: Option<PathBuf>,
    /// The last lines of its output.
    pub tail: Tail,
    /// The file of its output.
    pub log: Option<PathBuf>,
    /// Records its usage, if it has no control group of its own.
    pub peak: Option<Arc<Peak>>,
}

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

/// Number of rotated files of its output.
const OLD_LOGS: usize = 1;
/// Timeout of reading the rest of an output.
const LAST_OUTPUT: Duration = Duration::from_secs(1);

/// Starts a Webots on its target. The future resolves when its whole process tree has ended.
///
/// # Errors
/// When a process, a thread or a directory can't be created.
pub fn launch(
    spec: &LaunchSpec,
    target: LaunchTarget,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(Launched, impl Future<Output = End> + use<>)> {
    let log = spec.log_file();
    let file = RotatedFile::open(&log, OLD_LOGS).inspect_err(|error| {
        let why = format!("what Webots prints is not kept: {} can't be written: {error}", log.display());
        spec.slot.lease.log(log::Level::Warn, &why, &why);
    });
    let log = file.is_ok().then_some(log);
    let (reader, output) = std::io::pipe()?;
    let (tail, all_read) = output::follow(reader, spec.config.limits.output << 10, file.ok(), events)?;
    let errors = output.try_clone()?;
    let (process, cgroup) = match &target {
        LaunchTarget::Containers(containers) => (containers.spawn_spec(spec.config.timing.grace), None),
        LaunchTarget::Machine(display) => spec.spawn_spec(display)?,
    };
    let (group, ended) = ProcessGroup::start(&process, output.into(), errors.into())?;
    let folder = cgroup.as_ref().map(|cgroup| cgroup.path().to_owned());
    let peak = cgroup.is_none().then(|| peak_of(&target));
    let seen = peak.clone();
    let ended = async move {
        let reason = ended.await;
        let code = if let ExitReason::Code(code) = reason { Some(code.into()) } else { None };
        let in_container = target.end(code).await;
        let (on_machine, taken) = match cgroup {
            Some(cgroup) => actix_rt::task::spawn_blocking(move || end_all(&cgroup)).await.unwrap_or_default(),
            None => (false, seen.map(|peak| peak.taken()).unwrap_or_default()),
        };
        // The last output shows the cause. A process that can't be killed may keep the pipe open.
        actix_rt::time::timeout(LAST_OUTPUT, all_read).await.ok();
        End { reason, cause: in_container.or(on_machine.then_some(Cause::OutOfMemory)), taken }
    };
    Ok((Launched { group, cgroup: folder, tail, log, peak }, ended))
}

/// Hears what a Webots takes that runs on this.
fn peak_of(target: &LaunchTarget) -> Arc<Peak> {
    let LaunchTarget::Containers(containers) = target else { return Arc::default() };
    let (ids, peak) = (containers.ids(), Arc::new(Peak::of_containers()));
    let named = Arc::clone(&peak);
    // Its start does not wait for that.
    actix_rt::spawn(async move { named.name_containers(ids.await) });
    peak
}

/// Ends what has left the process group. Returns whether the kernel has ended something because it took too much memory,
/// and what all has taken.
fn end_all(cgroup: &Cgroup) -> (bool, Taken) {
    cgroup.kill();
    (cgroup.has_run_out_of_memory(), cgroup.taken())
}
