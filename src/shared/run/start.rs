//! Start of a program: configuration, log, then the server, and the exit code.

use std::fs::{File, TryLockError};
use std::io::{self, Read, Write};
use std::mem::ManuallyDrop;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use super::{logging, service_manager};
use crate::shared::config::{self, Configuration, LoadedConfig};
use crate::shared::text::one_line;

/// Why a server can't start, or can't continue, in one line.
pub type AppError = Box<dyn std::error::Error + Send + Sync>;

/// Exit code: the server failed at run time, for example because its port is in use.
pub const FAILED: u8 = 1;
/// Exit code: the configuration is invalid.
const WRONG_CONFIGURATION: u8 = 2;

/// The options that both programs have.
#[derive(clap::Args)]
pub struct CommonArgs {
    /// Print the effective configuration, and on the simulation server what the machine lacks, and end
    #[arg(long)]
    pub check: bool,
    /// Print the JSON schema of configuration files, by which editors complete and check them, and end
    #[arg(long)]
    pub schema: bool,
    /// Write the process id to this file, and keep the file locked while the server runs
    #[arg(long, value_name = "FILE")]
    pub pid_file: Option<PathBuf>,
}

/// Reads a configuration file. If it is invalid, prints the error in one line and exits.
pub fn read<C: Configuration>(file: &Path) -> LoadedConfig<C> {
    config::load(file).unwrap_or_else(|error| refuse(&error))
}

fn refuse(why: &str) -> ! {
    // A key may contain any text.
    eprintln!("error: {}", one_line(why));
    std::process::exit(WRONG_CONFIGURATION.into())
}

/// Prints the effective configuration to standard output.
pub fn print<C: Configuration>(loaded: &LoadedConfig<C>) {
    let text = serde_json::to_string_pretty(&loaded.config).unwrap_or_else(|error| refuse(&error.to_string()));
    // The reader may have closed the pipe.
    writeln!(io::stdout(), "{text}").ok();
}

/// Prints the JSON schema of a configuration to standard output.
pub fn print_schema<C: Configuration>() -> ExitCode {
    // The reader may have closed the pipe.
    writeln!(io::stdout(), "{:#}", config::schema::<C>()).ok();
    ExitCode::SUCCESS
}

/// Prints the warnings about a configuration to the error output. Returns the exit code of `--check`: an unknown key is
/// probably mistyped, so that the configuration is not what its author means.
pub fn conclude<C: Configuration>(loaded: &LoadedConfig<C>) -> ExitCode {
    for warning in &loaded.warnings {
        eprintln!("warning: {}", one_line(warning));
    }
    for unknown in &loaded.unknown {
        eprintln!("error: {}", one_line(unknown));
    }
    if loaded.unknown.is_empty() {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(WRONG_CONFIGURATION)
    }
}

/// Writes the PID file if requested, and locks it (`flock`) until the returned file is closed. The kernel closes it when
/// the process ends for any reason.
///
/// # Errors
/// The exit code, when it can't be written, or another server holds it.
pub fn claim_pid_file(options: &CommonArgs) -> Result<Option<File>, ExitCode> {
    let claimed = options.pid_file.as_deref().map(claim).transpose();
    claimed.map_err(|error| failed(&format!("the process id can't be written: {error}")))
}

/// Starts the log (without a file on standard output), and runs a server to its end.
pub fn serve(log: Option<&Path>, warnings: &[String], server: impl Future<Output = Result<(), AppError>>) -> ExitCode {
    if let Err(error) = logging::start(log) {
        let log = log.unwrap_or(Path::new("to standard output"));
        return failed(&format!("the log {} can't be written: {error}", log.display()));
    }
    // A panic is a bug in this program. It is logged, because a service has no terminal.
    std::panic::set_hook(Box::new(|panic| log::error!("{panic}")));
    for warning in warnings {
        log::warn!("{warning}");
    }
    // It is not dropped, because that would wait for blocking threads, such as a slow DNS lookup.
    let system = ManuallyDrop::new(actix_rt::System::new());
    match system.block_on(server) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            failed(&error.to_string())
        }
    }
}

fn claim(path: &Path) -> io::Result<File> {
    let mut file = File::options()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .open(path)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let mut pid = String::new();
            file.read_to_string(&mut pid)?;
            return Err(io::Error::other(format!(
                "a server that runs holds it: process {}",
                pid.trim()
            )));
        }
        Err(TryLockError::Error(error)) => return Err(error),
    }
    write_pid(&file)?;
    Ok(file)
}

/// Writes the process id to a PID file.
///
/// # Errors
/// When the disk is full or broken.
pub fn write_pid(file: &File) -> io::Result<()> {
    file.set_len(0)?;
    file.write_all_at(format!("{}\n", std::process::id()).as_bytes(), 0)
}

/// Reports to the log, standard output and the service manager that a server is reachable: its HTTP URL and its
/// WebSocket URL.
pub fn announce(server: &str, http: &str, websocket: &str, port: u16) {
    log::info!("{server} {} listens on port {port}: {http}", env!("CARGO_PKG_VERSION"));
    // The reader may have closed the pipe.
    writeln!(io::stdout(), "{server:<18} {http}/monitor   {websocket}").ok();
    service_manager::ready(port);
}

/// Prints why a program has failed. Returns its exit code.
pub fn failed(why: &str) -> ExitCode {
    eprintln!("error: {why}");
    ExitCode::from(FAILED)
}
