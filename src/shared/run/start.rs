//! How a program starts: configuration, log, then the server, and an exit code.

use std::io::Write;
use std::mem::ManuallyDrop;
use std::path::Path;
use std::process::ExitCode;

use super::logging::{self, LogTarget, one_line};
use crate::shared::config::{self, Configuration, Loaded};

/// The server failed at run time: a port that is taken, an actor that is gone.
pub const FAILED: u8 = 1;
/// The configuration can't be used.
pub const WRONG_CONFIGURATION: u8 = 2;

/// Reads a configuration, or says in one line why it can't be used.
///
/// # Errors
/// The exit code.
pub fn read<C: Configuration>(file: &Path) -> Result<Loaded<C>, ExitCode> {
    config::load(file).map_err(|error| {
        // A key may hold anything.
        eprintln!("error: {}", one_line(&error.to_string()));
        ExitCode::from(WRONG_CONFIGURATION)
    })
}

/// Prints the effective configuration, and warnings to the error output.
#[must_use]
pub fn check<C: Configuration>(loaded: &Loaded<C>) -> ExitCode {
    for warning in &loaded.warnings {
        eprintln!("warning: {}", one_line(warning));
    }
    match serde_json::to_string_pretty(&loaded.config) {
        Ok(text) => {
            // Nobody may be listening any more.
            writeln!(std::io::stdout(), "{text}").ok();
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(WRONG_CONFIGURATION)
        }
    }
}

/// Starts the log and runs a server to its end.
pub fn serve<E: std::error::Error>(
    log: &Path,
    debug: bool,
    warnings: &[String],
    server: impl Future<Output = Result<(), E>>,
) -> ExitCode {
    let target = if debug { LogTarget::Stdout } else { LogTarget::File(log) };
    if let Err(error) = logging::start(target) {
        eprintln!("error: the log {} can't be written: {error}", log.display());
        return ExitCode::from(FAILED);
    }
    // A panic is a fault in this program; without this it would be told to a terminal that nobody looks at.
    std::panic::set_hook(Box::new(|panic| log::error!("{panic}")));
    for warning in warnings {
        log::warn!("{warning}");
    }
    // It is left to the end of the process: dropped, it would wait for threads that the system keeps, in a lookup of a
    // name that takes long.
    let system = ManuallyDrop::new(actix_rt::System::new());
    match system.block_on(server) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            eprintln!("error: {error}");
            ExitCode::from(FAILED)
        }
    }
}
