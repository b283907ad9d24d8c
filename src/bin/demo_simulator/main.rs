//! A stand-in for Webots: takes its command line and implements its standard output and its streaming protocol, so that
//! a fleet can be tried, tested and measured on a machine without Webots. The servers contain no code for it; a
//! configuration names it as the Webots to start.
//!
//! It does not read world files beyond their first lines: the scene and the motion come from two files beside the world,
//! from an export of Webots in its project, or from a small built-in scene (`scene`). It simulates no physics, runs no controllers and renders no pictures.
//! `docs/webots.md` compares it with Webots.
//!
//! `main` reads the command line, opens the port, and only then loads the world, as Webots does. One thread does
//! everything, as the event loop of Webots: an actor, the `simulation`, and a task for each connection (`http`), which
//! of a WebSocket is a `client`. While that thread is blocked, nothing is answered.

mod animation;
mod args;
mod client;
mod clients;
mod clock;
mod console;
mod files;
mod http;
mod motion;
mod phases;
mod port;
mod protocol;
mod robot_windows;
mod run;
mod scene;
mod simulation;
mod world;

use std::{env, process, thread};

use clap::Parser as _;

use crate::args::Args;

fn main() {
    let code = match Args::try_parse() {
        Ok(Args { version: true, .. }) => {
            console::status("Webots version: R2025a");
            0
        }
        Ok(Args { sysinfo: true, .. }) => {
            console::status(&system_info());
            0
        }
        Ok(args) => run::run(&args),
        Err(error) if !error.use_stderr() => {
            console::explain(&error.to_string()); // the help; Webots too prints it on the standard error
            0
        }
        Err(error) => {
            console::fatal(args::message(&error));
            console::explain("Try 'webots --help' for more information.");
            1
        }
    };
    process::exit(code);
}

/// What `--sysinfo` prints: system, processor and cores.
fn system_info() -> String {
    let cores = thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let system = env::consts::OS;
    let processor = env::consts::ARCH;
    format!("System: {system}\nProcessor: {processor}\nNumber of cores: {cores}\nOpenGL: none (demo simulator)")
}
