//! Plays a class of browsers against a fleet and says how many fit.
//!
//! It uses only the original's protocol, so that it also measures a fleet of Python servers. `arguments` is the command
//! line; `class` starts the clients, each of which is a `browser` that goes through the steps of Webots' web page and
//! records a `visit`; `servers` monitors the load; `report` and `table` show the result, with `real_time_factors` and
//! `line`.
//! `find` grows a class until simulations are slower than real time.
//! `explain` goes through the steps with one client and compares the results with the expected ones; `step_log` prints
//! the steps, `words` the texts.

mod arguments;
mod behaviour;
mod board;
mod browser;
mod class;
mod connection;
mod explain;
mod find;
mod http;
mod interruption;
mod line;
mod localhost;
mod paces;
mod real_time_factors;
mod report;
mod returning;
mod servers;
mod session_server;
mod stay;
mod step_log;
mod table;
mod visit;
mod words;

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;

use crate::arguments::Arguments;
use crate::class::Played;
use crate::interruption::interruption;

/// Exit code: fewer clients fit than expected, or nothing could be measured.
const NOT_AS_EXPECTED: u8 = 1;
/// Exit code: interrupted by Ctrl-C or SIGTERM; the code of shells for Ctrl-C.
const INTERRUPTED: u8 = 130;
/// Exit code: the arguments are invalid, or `--yes` is missing.
const WRONG_ARGUMENTS: u8 = 2;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Err(why) = arguments.prepare() {
        eprintln!("error: {why}");
        return ExitCode::from(WRONG_ARGUMENTS);
    }
    // Only the first call can set it, and this is the first.
    rustls::crypto::ring::default_provider().install_default().ok();
    let ended = actix_rt::System::new().block_on(async {
        if arguments.explain {
            explain(&arguments).await
        } else if arguments.find {
            find(&arguments).await
        } else {
            rehearse(&arguments).await
        }
    });
    ExitCode::from(ended.unwrap_or_else(|why| {
        eprintln!("error: {}", words::line(&why));
        NOT_AS_EXPECTED
    }))
}

fn code(is_as_expected: bool) -> u8 {
    if is_as_expected { 0 } else { NOT_AS_EXPECTED }
}

/// Walks through the steps of an acceptance run, and prints each at its end. Returns the exit code.
///
/// # Errors
/// When the fleet does not answer at all.
async fn explain(arguments: &Arguments) -> Result<u8, String> {
    tokio::select! {
        walked = Box::pin(explain::run(arguments)) => walked.map(code),
        () = interruption() => {
            writeln!(std::io::stdout(), "\nInterrupted: other steps were not made.").ok();
            Ok(INTERRUPTED)
        }
    }
}

/// Grows the class, and prints how many fit. Returns the exit code.
///
/// # Errors
/// When the fleet does not answer at all.
async fn find(arguments: &Arguments) -> Result<u8, String> {
    session_server::SessionServer::new(&arguments.fleet).answers().await?;
    let found = find::find(arguments).await;
    writeln!(std::io::stdout(), "{}", found.text()).ok();
    let expected = usize::try_from(arguments.expect.unwrap_or(1)).unwrap_or(usize::MAX);
    Ok(if found.interrupted {
        INTERRUPTED
    } else {
        code(found.fit() >= expected)
    })
}

/// Plays the class and prints the result. Returns the exit code.
///
/// # Errors
/// When the fleet does not answer at all, or the JSON file can't be written.
async fn rehearse(arguments: &Arguments) -> Result<u8, String> {
    session_server::SessionServer::new(&arguments.fleet).answers().await?;
    let Played {
        visits,
        peaks,
        interrupted,
    } = class::play(arguments).await;
    let mut report = report::Report::new(arguments, &visits, &peaks);
    if interrupted {
        report.interrupt();
    }
    // The reader may have closed the pipe.
    writeln!(std::io::stdout(), "{}", table::text(&report)).ok();
    if let Some(file) = &arguments.json {
        report
            .write(&visits, file)
            .map_err(|error| format!("{} can't be written: {error}", file.display()))?;
    }
    Ok(if interrupted {
        INTERRUPTED
    } else {
        code(report.is_as_expected())
    })
}
