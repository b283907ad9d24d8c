//! Plays a class of browsers against a fleet and says how many fit.
//!
//! It speaks the original's protocol alone, so that it measures a fleet of Python servers as well. `arguments` says what
//! can be asked for; `class` lets the clients come, each of which is a `browser` that goes through the steps of Webots' web
//! page and leaves a `visit` behind; `servers` watches the load meanwhile; `report` and `table` say what came of it.
//! `explain` goes through the steps with one client and compares what comes with what is expected; `walk` prints the steps, `words`
//! what came.

mod arguments;
mod behaviour;
mod board;
mod browser;
mod class;
mod conversation;
mod explain;
mod place;
mod report;
mod servers;
mod session;
mod table;
mod visit;
mod walk;
mod words;

use std::io::{BufRead, IsTerminal, Write};
use std::process::ExitCode;

use clap::Parser;

use crate::arguments::Arguments;

/// The class did not fit as `--expect` demands, or nothing could be measured.
const NOT_AS_EXPECTED: u8 = 1;
/// The arguments can't be used.
const WRONG_ARGUMENTS: u8 = 2;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    // Only the first call can set it, and this is the first.
    rustls::crypto::ring::default_provider().install_default().ok();
    if !arguments.yes && !place::is_this_machine(&arguments.fleet) && !may_load(&arguments) {
        eprintln!("error: nobody agreed to load {}; --yes agrees", arguments.fleet);
        return ExitCode::from(WRONG_ARGUMENTS);
    }
    let agreed = actix_rt::System::new().block_on(async {
        if arguments.explain { Box::pin(explain::run(&arguments)).await } else { rehearse(&arguments).await }
    });
    match agreed {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(NOT_AS_EXPECTED),
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(NOT_AS_EXPECTED)
        }
    }
}

/// Asks whoever sits at the terminal. Nobody there means no.
fn may_load(arguments: &Arguments) -> bool {
    if !std::io::stdin().is_terminal() {
        return false;
    }
    eprint!("{} is not this machine. Load it with {}? [y/N] ", arguments.fleet, arguments.summary());
    std::io::stderr().flush().ok();
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer).is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}

/// Plays the class and prints what came of it. Returns whether that is what was expected.
///
/// # Errors
/// When the fleet does not answer at all, or the file for machines can't be written.
async fn rehearse(arguments: &Arguments) -> Result<bool, String> {
    session::Session::new(&arguments.fleet).answers().await?;
    let (visits, servers) = class::play(arguments).await;
    let report = report::Report::new(arguments, &visits, &servers);
    // Nobody may be listening any more.
    writeln!(std::io::stdout(), "{}", table::text(&report)).ok();
    if let Some(file) = &arguments.json {
        report.write(&visits, file).map_err(|error| format!("{} can't be written: {error}", file.display()))?;
    }
    Ok(report.is_as_expected())
}
