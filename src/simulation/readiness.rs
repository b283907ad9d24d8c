//! Whether the server can start simulations at all. It is checked every five seconds, because Webots may be
//! reinstalled, and a disk or a display may fail and recover. The check does what a start does: it writes to the disk
//! and starts a process.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use which::which;

use super::config::{IsolationSetting, SimulationConfig};
use super::failed_starts::FailedStarts;
use crate::simulation::container::{daemon_fault, data_folder};
use crate::simulation::machine::Readings;
use crate::simulation::machine::display;
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::process::DiskRoom;

/// Interval between two checks.
const PERIOD: Duration = Duration::from_secs(5);
/// Interval while the server is not ready.
const PERIOD_WHILE_NOT_READY: Duration = Duration::from_secs(1);
/// Timeout of a check: a disk that does not answer blocks its writers. The next check starts only after the last one
/// has ended.
const HUNG: Duration = Duration::from_mins(1);
/// Bytes that each check writes to the disk. An empty file can be created on a full disk.
const WRITTEN: usize = 1 << 20;

/// Starts the checks. The channel contains the reason why the server can't start simulations, as text for clients and
/// administrators. `run` is the directory of this run. When the server is ready again, the count of failed starts is
/// reset.
pub fn watch(
    config: Arc<SimulationConfig>,
    run: PathBuf,
    readings: watch::Receiver<Arc<Readings>>,
    failed_starts: Arc<FailedStarts>,
) -> watch::Receiver<Option<String>> {
    // The first check comes before the first client; GPUs are not read yet.
    let first = check(&config, &run, None).err();
    let (sender, problem) = watch::channel(None);
    publish(&sender, first, &failed_starts);
    actix_rt::spawn(async move {
        while !sender.is_closed() {
            let pause = if sender.borrow().is_some() { PERIOD_WHILE_NOT_READY } else { PERIOD };
            actix_rt::time::sleep(pause).await;
            let (config, run, readings) = (Arc::clone(&config), run.clone(), Arc::clone(&readings.borrow()));
            let all = move || check(&config, &run, Some(&readings)).err();
            let mut checked = actix_rt::task::spawn_blocking(all);
            let found = if let Ok(found) = actix_rt::time::timeout(HUNG, &mut checked).await {
                found
            } else {
                let hangs = "This simulation server's disk or Docker does not answer".to_owned();
                publish(&sender, Some(hangs), &failed_starts);
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

/// Checks everything that each simulation needs. Blocks for two seconds for each display, and for as long as the disk does.
fn check(config: &SimulationConfig, run: &Path, readings: Option<&Readings>) -> Result<(), String> {
    let in_container = config.isolation == IsolationSetting::Container;
    readings.map_or(Ok(()), |readings| check_gpus(config, readings))?;
    if in_container {
        daemon_fault().map_or(Ok(()), Err)?;
    }
    webots_program(config)?;
    which("git").map_err(|_| "This simulation server has no git".to_owned())?;
    start_process().map_err(|error| format!("This simulation server can't start processes: {error}"))?;
    std::fs::create_dir_all(run).map_err(|error| not_writable(&error))?;
    check_room(run, "disk", config.disk_reserve)?;
    write(run)?;
    if let Some(folder) = in_container.then(data_folder).flatten() {
        check_room(&folder, "disk of Docker", config.disk_reserve)?;
    }
    // Webots itself always needs a display. A replacement (`webots`) may not.
    if config.webots.is_none() && !config.xvfb && !in_container {
        for display in displays(config, readings.map_or(&[], |readings| &readings.gpus)) {
            display::check(&display).map_err(|error| format!("Webots can't open its window: {error}"))?;
        }
    }
    Ok(())
}

/// The displays that simulations may be given: those of GPUs that answer, where each has its own.
fn displays(config: &SimulationConfig, gpus: &[Gpu]) -> BTreeSet<String> {
    let with_display = gpus.iter().filter(|gpu| (gpu.index as usize) < config.displays_of_gpus().len());
    let displays: BTreeSet<String> = with_display.map(|gpu| config.display_on(Some(gpu.index))).collect();
    if displays.is_empty() { [config.display_on(None)].into() } else { displays }
}

/// Checks that there are GPUs and none is lost, where they are required.
fn check_gpus(config: &SimulationConfig, readings: &Readings) -> Result<(), String> {
    if !config.require_gpu {
        return Ok(());
    }
    if let Some(problem) = &readings.gpu_problem {
        return Err(format!("This simulation server requires its GPUs (requireGpu), but {problem}"));
    }
    if readings.gpus.is_empty() {
        return Err("This simulation server requires a GPU (requireGpu), but sees none".to_owned());
    }
    Ok(())
}

/// Starts a process and waits for its end. That also needs file handles for its input and output.
fn start_process() -> std::io::Result<()> {
    let mut command = Command::new("true");
    match command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status() {
        // The new process did not find the program, so starting processes works.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        status => status.map(drop),
    }
}

/// Checks that the disk of a directory has `reserve` MiB and some inodes left for users. `disk` is its name.
fn check_room(folder: &Path, disk: &str, reserve: u64) -> Result<(), String> {
    let room = DiskRoom::of(folder).map_err(|error| not_writable(&error))?;
    let full = |left| Err(format!("This simulation server's {disk} is full: less than {left}"));
    room.shortage(reserve).map_or(Ok(()), full)
}

/// Writes an unnamed file, and waits until it is on the disk.
fn write(folder: &Path) -> Result<(), String> {
    // The error of `tempfile` contains the path; its kind is enough.
    let mut file = tempfile::tempfile_in(folder).map_err(|error| not_writable(&error.kind().into()))?;
    file.write_all(&vec![0; WRITTEN]).and_then(|()| file.sync_all()).map_err(|error| not_writable(&error))
}

fn not_writable(error: &std::io::Error) -> String {
    format!("This simulation server can't write in its cache: {error}")
}

/// The program that is started for each client; in a container, that of its image.
///
/// # Errors
/// What is missing, and how to set it, as text for the client.
pub fn webots_program(config: &SimulationConfig) -> Result<PathBuf, String> {
    if config.isolation == IsolationSetting::Container {
        return Ok(PathBuf::from(&config.container.program));
    }
    if config.xvfb && which("Xvfb").is_err() {
        return Err("This simulation server gives each Webots a display of its own (xvfb), but has no Xvfb. \
                    Its administrator can install it, or set xvfb: false and display"
            .to_owned());
    }
    let how = "Its administrator can set webotsHome in the server's configuration, or the environment variable \
               WEBOTS_HOME";
    let Some(program) = config.webots_program() else {
        return Err(format!("This simulation server does not know where Webots is installed. {how}."));
    };
    let program = std::path::absolute(&program).unwrap_or(program);
    which(&program).map_err(|_| {
        format!("This simulation server has no Webots that it can run at \"{}\". {how}.", program.display())
    })
}
