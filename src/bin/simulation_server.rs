//! The simulation server's program: arguments, configuration, log, then the server.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use webots_fleet::shared::run::start;
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::process::guardian;
use webots_fleet::simulation::{app, preflight};

/// Runs one Webots per web client.
#[derive(Parser)]
#[command(version, args_conflicts_with_subcommands = true)]
struct Arguments {
    /// Configuration file
    #[arg(default_value = "config/simulation/local.json")]
    config: PathBuf,
    /// Print the effective configuration, look for what simulations need, and end
    #[arg(long)]
    check: bool,
    /// The server itself, or a part of it.
    #[command(subcommand)]
    part: Option<Part>,
}

/// Parts of the server that are processes of their own.
#[derive(clap::Subcommand)]
enum Part {
    /// Used by the server itself: runs a program and ends with it
    #[command(hide = true)]
    Guard(guardian::Orders),
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Some(Part::Guard(orders)) = &arguments.part {
        return ExitCode::from(guardian::guard(orders));
    }
    let loaded = match start::read::<SimulationConfig>(&arguments.config) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.check {
        let code = start::check(&loaded);
        for finding in preflight::look(&loaded.config) {
            eprintln!("{finding}");
        }
        return code;
    }
    let log = loaded.config.log_dir.0.join("simulation/output.log");
    start::serve(&log, loaded.config.debug, &loaded.warnings, app::run(loaded.config.clone()))
}
