//! A stand-in for Webots: takes its command line and speaks its standard output and its streaming protocol,
//! with a small scene in which robots drive in circles. With it a whole fleet can be tried, tested and
//! measured on a machine that has no Webots. The servers know nothing of it; a configuration names it as
//! the Webots to start.
//!
//! It reads the same world files, as far as they are made of basic nodes (`kinds`), but it simulates no
//! physics, runs no controllers, and renders no pictures. On purpose it never misbehaves.
//!
//! `main` reads the command line, then opens the port, and only then has the world loaded, as Webots does:
//! a client that connects early is told about the loading. Two actors do the rest: `simulation`, the only
//! one, on the main thread, and a `client` for each WebSocket, on the server's one worker thread.

mod args;
mod audience;
mod client;
mod clock;
mod console;
mod files;
mod kinds;
mod lexer;
mod motion;
mod node;
mod port;
mod protocol;
mod run;
mod scene;
mod simulation;
mod stage;
mod vrml;
mod world;

use std::{env, process, thread};

use crate::args::Request;

/// What `--help` prints.
const USAGE: &str = "\
Usage: webots [options] [worldfile]

Options:
  --help                 Display this help message and exit
  --version              Display version information and exit
  --sysinfo              Display information about the system and exit
  --mode=<mode>          Start mode: pause, realtime (default) or fast
  --port=<port>          TCP port of the streaming server, or one of the ten after it (default 1234)
  --stream[=<mode>]      Stream to web clients: w3d (default) or x3d
  --heartbeat[=<time>]   Print a dot on stdout every <time> milliseconds (default 1000)
  --batch                No blocking dialogs (there are none)
  --stdout, --stderr     Print remarks; warnings and errors
  --minimize, --no-rendering, --fullscreen, --extern-urls, --log-performance=<file>[,<steps>]
                         Accepted, but without effect here

This is the demo simulator: it behaves like Webots towards a simulation server and its clients.";

fn main() {
    let code = match args::parse(env::args().skip(1)) {
        Ok(Request::Run(options)) => run::run(&options),
        Ok(Request::Version) => {
            console::status("Webots version: R2025a");
            0
        }
        Ok(Request::SystemInfo) => {
            console::status(&system_info());
            0
        }
        Ok(Request::Help) => {
            console::explain(USAGE);
            0
        }
        Err(error) => {
            console::fatal(error);
            console::explain("Try 'webots --help' for more information.");
            1
        }
    };
    process::exit(code);
}

/// What `--sysinfo` prints: system, processor and cores.
fn system_info() -> String {
    let cores = thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let (system, processor) = (env::consts::OS, env::consts::ARCH);
    format!("System: {system}\nProcessor: {processor}\nNumber of cores: {cores}\nOpenGL: none (demo simulator)")
}
