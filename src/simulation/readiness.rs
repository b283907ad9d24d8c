//! Whether the server can start simulations at all. It is checked every five seconds, because Webots may be
//! reinstalled, and a disk or a display may fail and recover.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use tokio::sync::{oneshot, watch};
use which::which;

use super::config::SimulationConfig;
use crate::shared::domain::Failure;
use crate::simulation::container::{daemon_fault, docker_disk_fault};
use crate::simulation::machine::{Readings, display};
use crate::simulation::process::disk_fault;

/// Interval between two checks.
const PERIOD: Duration = Duration::from_secs(5);
/// Interval while the server is not ready.
const PERIOD_WHILE_NOT_READY: Duration = Duration::from_secs(1);
/// Timeout of a check: a disk that does not answer blocks its writers. The next check starts only after this one has
/// ended.
const HUNG: Duration = Duration::from_mins(1);

/// Number of consecutive failed starts of which this server is the cause. A start that failed because of its world or
/// its client does not change it. Session servers prefer servers without failed starts.
#[derive(Debug, Default)]
pub struct FailedStarts(AtomicU32);

impl FailedStarts {
    /// Counts a failed start.
    pub fn add(&self, why: &str) {
        let count = self.0.fetch_add(1, Ordering::Relaxed) + 1;
        log::warn!("a start has failed for a reason of this server's own, {count} in a row: {why}");
    }

    /// Resets the count: a start has succeeded, or the server's problem is solved.
    pub fn reset(&self) {
        self.0.store(0, Ordering::Relaxed);
    }

    /// Returns the count.
    pub fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Starts the checks. The channel contains the reason why the server can't start simulations, as text for clients and
/// administrators. `run` is the directory of this run. When the server is ready again, the count of failed starts is
/// reset.
pub fn watch(
    config: Arc<SimulationConfig>,
    run: PathBuf,
    readings: watch::Receiver<Arc<Readings>>,
    failed_starts: Arc<FailedStarts>,
) -> watch::Receiver<Option<String>> {
    // The first check runs before the first client; GPUs are not read yet.
    let first = check(&config, &run, None).err();
    let (sender, problem) = watch::channel(None);
    publish(&sender, first, &failed_starts);
    actix_rt::spawn(async move {
        while !sender.is_closed() {
            let pause = if sender.borrow().is_some() {
                PERIOD_WHILE_NOT_READY
            } else {
                PERIOD
            };
            actix_rt::time::sleep(pause).await;
            let config = Arc::clone(&config);
            let run = run.clone();
            let readings = Arc::clone(&readings.borrow());
            let (told, mut checked) = oneshot::channel();
            // A thread for each check, because simulations need new threads, too.
            let started = std::thread::Builder::new().name("readiness".to_owned()).spawn(move || {
                told.send(check(&config, &run, Some(&readings)).err()).ok();
            });
            let found = if let Err(error) = started {
                Ok(Some(format!("This simulation server can't start a thread: {error}")))
            } else if let Ok(found) = actix_rt::time::timeout(HUNG, &mut checked).await {
                found
            } else {
                publish(
                    &sender,
                    Some("This server's disk or Docker does not answer".to_owned()),
                    &failed_starts,
                );
                checked.await
            };
            if let Ok(found) = found {
                publish(&sender, found, &failed_starts);
            }
        }
    });
    problem
}

/// Publishes the result of a check, and logs it if it is new.
fn publish(sender: &watch::Sender<Option<String>>, found: Option<String>, failed_starts: &FailedStarts) {
    sender.send_if_modified(|problem| {
        let is_new = *problem != found;
        match &found {
            Some(why) if is_new => log::error!("no simulation can be started: {why}"),
            None if is_new => {
                failed_starts.reset();
                log::info!("simulations can be started again");
            }
            _ => {}
        }
        *problem = found;
        is_new
    });
}

/// Checks everything that each simulation needs. Blocks for up to two seconds per display, and as long as the disk.
fn check(config: &SimulationConfig, run: &Path, readings: Option<&Readings>) -> Result<(), String> {
    readings.map_or(Ok(()), |readings| check_gpus(config, readings))?;
    let none = |fault: Option<Failure>| fault.map_or(Ok(()), |failure| Err(failure.in_full()));
    if config.docker {
        none(daemon_fault())?;
    }
    webots_program(config)?;
    which("git").map_err(|_| "This simulation server has no git".to_owned())?;
    none(disk_fault(run, config.disk_reserve))?;
    if config.docker {
        none(docker_disk_fault(config.disk_reserve))?;
    }
    if config.xvfb && !config.docker {
        find_xvfb()?;
    } else if config.webots.is_none() && !config.docker {
        // Webots itself always needs a display. A replacement (`webots`) may not.
        let found = config
            .all_displays()
            .iter()
            .try_for_each(|display| display::check(display));
        found.map_err(|error| format!("Webots can't open its window: {error}"))?;
    }
    Ok(())
}

/// Checks that there are GPUs and none is lost, if they are required.
fn check_gpus(config: &SimulationConfig, readings: &Readings) -> Result<(), String> {
    let none = || readings.gpus.is_empty().then(|| "sees none".to_owned());
    match readings.gpu_problem.clone().or_else(none) {
        Some(problem) if config.require_gpu => Err(format!(
            "This simulation server requires its GPUs (requireGpu), but {problem}"
        )),
        _ => Ok(()),
    }
}

/// Finds the program for virtual displays.
///
/// # Errors
/// That it is missing, and what to do, as text for the client.
pub fn find_xvfb() -> Result<PathBuf, String> {
    let missing = "This simulation server gives each Webots a display of its own (xvfb), but has no Xvfb. Its \
                   administrator can install it, or set xvfb: false and display";
    which("Xvfb").map_err(|_| missing.to_owned())
}

/// The program that is started for each client; in a container, that of its image.
///
/// # Errors
/// What is missing, and how to set it, as text for the client.
pub fn webots_program(config: &SimulationConfig) -> Result<PathBuf, String> {
    if config.docker {
        return Ok(PathBuf::from(&config.container.program));
    }
    let remedy = "Its administrator can set webotsHome in the server's configuration, or the environment variable \
               WEBOTS_HOME";
    let in_home = config.webots_home.as_ref().map(|home| home.0.join("webots"));
    let Some(program) = config.webots.as_ref().map(|program| program.0.clone()).or(in_home) else {
        return Err(format!(
            "This simulation server does not know where Webots is installed. {remedy}."
        ));
    };
    let program = std::path::absolute(&program).unwrap_or(program);
    which(&program).map_err(|_| {
        format!(
            "This simulation server has no Webots that it can run at \"{}\". {remedy}.",
            program.display()
        )
    })
}
