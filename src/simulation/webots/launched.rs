//! Prepares the target on which a Webots runs, starts its process there, and waits until its whole process tree has ended.

use std::future::Future;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;

use super::launch_spec::LaunchSpec;
use super::output::{self, OutputEvent, Tail};
use crate::shared::run::RotatedFile;
use crate::simulation::container::{Cause, SimulationContainers, StartError};
use crate::simulation::ends::{FOLDER_OF_RUNNING, Taken};
use crate::simulation::isolation::{Display, Peak};
use crate::simulation::process::{ExitReason, ProcessGroup};

/// The target on which a Webots runs.
pub enum LaunchTarget {
    /// The machine, with this display.
    Machine(Display),
    /// Containers.
    Containers(Box<SimulationContainers>),
}

/// A Webots that was started.
pub struct Launched {
    /// Its processes.
    pub group: ProcessGroup,
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

/// Size from which the file of its output is rotated, in bytes.
const MAX_LOG: u64 = 500_000;
/// Timeout of reading the rest of an output.
const LAST_OUTPUT: Duration = Duration::from_secs(1);

impl LaunchTarget {
    /// Prepares the target of a Webots: containers, a display of its own, or nothing. `progress` receives each step as text.
    /// Dropping the future discards what was created. Its error says why it failed, and whether the project or this server
    /// is the cause.
    pub fn prepare<P: Fn(String) + Send + Sync + 'static>(
        spec: &LaunchSpec,
        progress: P,
    ) -> impl Future<Output = Result<Self, StartError>> + use<P> {
        let containers = spec.containers.as_ref().map(|containers| (Arc::clone(containers), spec.request()));
        let (xvfb, display, instance) = (spec.config.xvfb, spec.display(), spec.project.instance.path().to_owned());
        async move {
            if let Some((containers, request)) = containers {
                let mut prepared = containers.prepare(request, &progress).await?;
                prepared.start_others().await?;
                return Ok(Self::Containers(Box::new(prepared)));
            }
            let display = if xvfb { Display::new_virtual(&instance) } else { Ok(Display::Outside(display)) };
            let failed = |error| StartError::Server(format!("The virtual display (Xvfb) can't be started: {error}"));
            display.map(Self::Machine).map_err(failed)
        }
    }
}

/// Starts a Webots on its target. The future resolves when its whole process tree has ended.
///
/// # Errors
/// When a process, a thread or a directory can't be created.
pub fn launch(
    spec: &LaunchSpec,
    target: LaunchTarget,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(Launched, impl Future<Output = End> + use<>)> {
    let folder = spec.config.log_dir.0.join("simulation").join(FOLDER_OF_RUNNING);
    let log = folder.join(format!("{}.log", spec.slot.lease.id()));
    let file = RotatedFile::open(&log, MAX_LOG, "").inspect_err(|error| {
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
    let peak = cgroup.is_none().then(|| peak_of(&target));
    let seen = peak.clone();
    let ended = async move {
        let reason = ended.await;
        let mut in_container = None;
        if let LaunchTarget::Containers(containers) = target {
            in_container = containers.cause(reason).await;
            containers.remove().await;
        }
        // This ends also what has left the process group.
        let (on_machine, taken) = match cgroup {
            Some(cgroup) => actix_rt::task::spawn_blocking(move || cgroup.end()).await.unwrap_or_default(),
            None => (false, seen.map(|peak| peak.taken()).unwrap_or_default()),
        };
        // The last output shows the cause. A process that can't be killed may keep the pipe open.
        actix_rt::time::timeout(LAST_OUTPUT, all_read).await.ok();
        End { reason, cause: in_container.or(on_machine.then_some(Cause::OutOfMemory)), taken }
    };
    Ok((Launched { group, tail, log, peak }, ended))
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
