//! Plays a class of browsers against a fleet and says how many fit.
//!
//! It uses only the original's protocol, so that it also measures a fleet of Python servers. `arguments` is the command
//! line; `consent` asks before another machine is loaded; `class` starts the clients, each of which is a `browser` that
//! goes through the steps of Webots' web page and records a `visit`; `servers` monitors the load; `report` and `table`
//! show the result, with `real_time_factors` and `reasons`. `explain` goes through the steps with one client and
//! compares the results with the expected ones; `step_log` prints the steps, `words` the texts.

mod arguments;
mod behaviour;
mod board;
mod browser;
mod class;
mod connection;
mod consent;
mod explain;
mod interruption;
mod localhost;
mod real_time_factors;
mod reasons;
mod report;
mod returning;
mod servers;
mod session;
mod step_log;
mod table;
mod visit;
mod words;

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;

use crate::arguments::Arguments;
use crate::class::Played;
use crate::consent::Consent;
use crate::interruption::interruption;

/// Exit code: fewer clients fit than expected, or nothing could be measured.
const NOT_AS_EXPECTED: u8 = 1;
/// Exit code: interrupted by Ctrl-C or SIGTERM; the code of shells for Ctrl-C.
const INTERRUPTED: u8 = 130;
/// Exit code: the arguments are invalid.
const WRONG_ARGUMENTS: u8 = 2;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Err(why) = arguments.prepare() {
        eprintln!("error: {why}");
        return ExitCode::from(WRONG_ARGUMENTS);
    }
    // Only the first call can set it, and this is the first.
    rustls::crypto::ring::default_provider().install_default().ok();
    let consent = Consent::new(&arguments);
    let ended = actix_rt::System::new().block_on(async {
        if !consent.has_fleet() {
            return Err(refused(&consent));
        }
        if arguments.explain { explain(&arguments, &consent).await } else { rehearse(&arguments, &consent).await }
    });
    match ended {
        Ok(code) => ExitCode::from(code),
        Err(fault) => {
            let (code, why) = match fault {
                Fault::NotAgreed(why) => (WRONG_ARGUMENTS, why),
                Fault::Failed(why) => (NOT_AS_EXPECTED, why),
            };
            eprintln!("error: {}", words::line(&why));
            ExitCode::from(code)
        }
    }
}

fn code(is_as_expected: bool) -> u8 {
    if is_as_expected { 0 } else { NOT_AS_EXPECTED }
}

fn refused(consent: &Consent<'_>) -> Fault {
    Fault::NotAgreed(consent.refusal().unwrap_or_default())
}

/// Why nothing can be measured, as text.
enum Fault {
    /// The user did not agree to load another machine.
    NotAgreed(String),
    /// There is nothing to measure, or the result can't be written.
    Failed(String),
}

impl From<String> for Fault {
    fn from(why: String) -> Self {
        Self::Failed(why)
    }
}

/// Walks through the steps of an acceptance run, and prints each at its end. Returns the exit code.
///
/// # Errors
/// When the fleet does not answer at all, or the user did not agree to load all of it.
async fn explain(arguments: &Arguments, consent: &Consent<'_>) -> Result<u8, Fault> {
    tokio::select! {
        walked = Box::pin(explain::run(arguments, consent)) => walked.map(code),
        () = interruption() => {
            writeln!(std::io::stdout(), "\nInterrupted: other steps were not made.").ok();
            Ok(INTERRUPTED)
        }
    }
}

/// Plays the class and prints the result. Returns the exit code.
///
/// # Errors
/// When the fleet does not answer at all, the user did not agree to load all of it, or the JSON file can't be written.
async fn rehearse(arguments: &Arguments, consent: &Consent<'_>) -> Result<u8, Fault> {
    session::Session::new(&arguments.fleet).answers().await?;
    let Played { visits, peaks, interrupted } = class::play(arguments, consent).await;
    if consent.refusal().is_some() {
        return Err(refused(consent));
    }
    let mut report = report::Report::new(arguments, &visits, &peaks);
    if interrupted {
        report.interrupt();
    }
    // The reader may have closed the pipe.
    writeln!(std::io::stdout(), "{}", table::text(&report)).ok();
    if let Some(file) = &arguments.json {
        report.write(&visits, file).map_err(|error| format!("{} can't be written: {error}", file.display()))?;
    }
    Ok(if interrupted { INTERRUPTED } else { code(report.is_as_expected()) })
}
