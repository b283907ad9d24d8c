//! Whether the server can start simulations at all. Checked every five seconds: Webots may be installed anew, a disk or a
//! display may go and come back.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use which::which;

use super::config::{Isolation, SimulationConfig};
use crate::simulation::container::{daemon_fault, init_fault};
use crate::simulation::machine::display;

/// Time between two checks.
const PERIOD: Duration = Duration::from_secs(5);

/// Starts the checks. The channel holds why the server can start no simulation, in words for clients and administrators.
/// `run` is the folder of this run.
#[must_use]
pub fn watch(config: Arc<SimulationConfig>, run: PathBuf) -> watch::Receiver<Option<String>> {
    let (sender, problem) = watch::channel(None);
    actix_rt::spawn(async move {
        let mut period = actix_rt::time::interval(PERIOD);
        let mut has_init = false;
        while !sender.is_closed() {
            period.tick().await;
            let (config, run) = (Arc::clone(&config), run.clone());
            let checked = move || {
                let found = check(&config, &run).and_then(|()| check_init(&config, has_init));
                (found.is_ok(), found.err())
            };
            let Ok((works, found)) = actix_rt::task::spawn_blocking(checked).await else {
                continue;
            };
            has_init |= works;
            sender.send_if_modified(|problem| {
                let is_new = *problem != found;
                match &found {
                    Some(why) if is_new => log::error!("no simulation can be started: {why}"),
                    None if is_new => log::info!("simulations can be started again"),
                    _ => {}
                }
                *problem = found;
                is_new
            });
        }
    });
    problem
}

/// Checks everything that each simulation needs. Blocks for two seconds at most.
fn check(config: &SimulationConfig, run: &Path) -> Result<(), String> {
    if config.isolation == Isolation::Container {
        daemon_fault().map_or(Ok(()), Err)?;
    }
    webots_program(config)?;
    which("git").map_err(|_| "This simulation server has no git".to_owned())?;
    let not_writable = |error| format!("This simulation server can't write in its cache: {error}");
    std::fs::create_dir_all(run).map_err(not_writable)?;
    tempfile::tempfile_in(run).map_err(not_writable)?;
    // Webots itself always needs a display. What stands in for it (`webots`) may not.
    if config.webots.is_none() && !config.xvfb && config.isolation != Isolation::Container {
        let display = display::effective(config.display.as_ref());
        display::check(&display).map_err(|error| format!("Webots can't open its window: {error}"))?;
    }
    Ok(())
}

/// Checks that containers can have an init process. One that was found is not looked for again: it takes a container.
fn check_init(config: &SimulationConfig, has_init: bool) -> Result<(), String> {
    if has_init || config.isolation != Isolation::Container {
        return Ok(());
    }
    init_fault().map_or(Ok(()), Err)
}

/// The program that is started for each client; in a container, that of its image.
///
/// # Errors
/// What is missing, and how to set it, in words for the client.
pub fn webots_program(config: &SimulationConfig) -> Result<PathBuf, String> {
    if config.isolation == Isolation::Container {
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
    which(&program)
        .map_err(|_| format!("This simulation server has no Webots that it can run at {}. {how}.", program.display()))
}
