//! The program `simulation-server`: reads its arguments and its configuration, then runs the server.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use webots_fleet::shared::run::start;
use webots_fleet::simulation::app::{self, Application, Origin};
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::process::guardian;
use webots_fleet::simulation::{container, preflight, upgrade};

/// Runs one Webots per web client.
#[derive(Parser)]
#[command(version, args_conflicts_with_subcommands = true)]
struct Arguments {
    /// Configuration file
    #[arg(default_value = "config/simulation/local.json")]
    config: PathBuf,
    #[command(flatten)]
    options: start::CommonArgs,
    /// Used by the server itself: take over from the process that has started this one
    #[arg(long, hide = true)]
    takes_over: bool,
    /// The server itself, or a part of it.
    #[command(subcommand)]
    part: Option<Part>,
}

/// Parts of the server that are processes of their own.
#[derive(clap::Subcommand)]
enum Part {
    /// Used by the server itself: ends the simulations when the server is gone
    #[command(hide = true)]
    Guard(guardian::Arguments),
    /// Has the running server with this configuration started anew: the new process takes over, and the one before serves
    /// its simulations until their clients leave
    Upgrade {
        /// Configuration file
        config: PathBuf,
    },
    /// Used by the service manager: removes the containers that a server with this configuration has left
    #[command(hide = true)]
    Sweep {
        /// Configuration file
        config: PathBuf,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Some(Part::Sweep { config }) = &arguments.part {
        let config = start::read::<SimulationConfig>(config).config;
        if config.docker {
            container::sweep_all(&container::ResourceOwner::of(&config.cache_dir.0));
        }
        return ExitCode::SUCCESS;
    }
    if let Some(Part::Guard(arguments)) = &arguments.part {
        let sweep = |owner: &String| container::sweep_all(&container::ResourceOwner(owner.clone()));
        let remove = || arguments.containers.iter().for_each(sweep);
        return ExitCode::from(guardian::guard(arguments, remove));
    }
    if let Some(Part::Upgrade { config }) = &arguments.part {
        return match upgrade::request(&start::read::<SimulationConfig>(config).config) {
            Ok(what) => {
                println!("{what}");
                ExitCode::SUCCESS
            }
            Err(why) => start::failed(&why),
        };
    }
    if arguments.options.schema {
        return start::print_schema::<SimulationConfig>();
    }
    let loaded = start::read::<SimulationConfig>(&arguments.config);
    if arguments.options.check {
        start::print(&loaded);
        for finding in preflight::check(&loaded.config) {
            eprintln!("{finding}");
        }
        return start::conclude(&loaded);
    }
    let origin = match Origin::find(arguments.takes_over, &arguments.options) {
        Ok(origin) => origin,
        Err(code) => return code,
    };
    let log = loaded.config.log_dir.0.join("simulation/output.log");
    let log = (!loaded.config.debug).then_some(log.as_path());
    let server = async { app::serve(Application::new(loaded.config.clone(), origin)?).await };
    start::serve(log, &loaded.remarks(), server)
}
