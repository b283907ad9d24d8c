//! Webots' command line.

use std::path::PathBuf;

use clap::{Parser, value_parser};

use crate::clock::Mode;

/// The demo simulator behaves like Webots towards a simulation server and its clients.
#[derive(Debug, Parser)]
#[command(
    name = "webots",
    override_usage = "webots [options] [worldfile]",
    args_override_self = true
)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is an independent switch of the command line"
)]
pub(crate) struct Args {
    /// World file to simulate
    #[arg(required_unless_present_any = ["version", "sysinfo"])]
    pub(crate) world: Option<PathBuf>,
    /// Display version information and exit
    #[arg(long)]
    pub(crate) version: bool,
    /// Display information about the system and exit
    #[arg(long)]
    pub(crate) sysinfo: bool,
    /// Start mode
    #[arg(long, value_enum, default_value = "realtime", require_equals = true)]
    pub(crate) mode: Mode,
    /// TCP port of the streaming server; if it is taken, one of the ten after it
    #[arg(long, default_value = "1234", require_equals = true, value_parser = value_parser!(u16).range(1..))]
    pub(crate) port: u16,
    /// Stream to web clients: w3d or x3d
    #[arg(long, num_args = 0..=1, default_missing_value = "w3d", require_equals = true, value_parser = stream_mode)]
    pub(crate) stream: Option<String>,
    /// Print a dot on stdout every so many milliseconds
    #[arg(long, num_args = 0..=1, default_missing_value = "1000", require_equals = true,
        value_parser = value_parser!(u64).range(1..))]
    pub(crate) heartbeat: Option<u64>,
    /// No blocking dialogs (there are none)
    #[arg(long)]
    pub(crate) batch: bool,
    /// Print information on stdout
    #[arg(long)]
    pub(crate) stdout: bool,
    /// Print warnings and errors on stderr
    #[arg(long)]
    pub(crate) stderr: bool,
    // accepted, but without effect
    #[arg(long, hide = true)]
    minimize: bool,
    #[arg(long, hide = true)]
    no_rendering: bool,
    #[arg(long, hide = true)]
    fullscreen: bool,
    #[arg(long, hide = true)]
    extern_urls: bool,
    #[arg(long, hide = true, require_equals = true)]
    log_performance: Option<String>,
}

fn stream_mode(value: &str) -> Result<String, &'static str> {
    match value {
        "w3d" | "x3d" => Ok(value.to_owned()),
        "mjpeg" => Err("the demo simulator renders no pictures; use --stream=w3d"),
        _ => Err("the modes are w3d and x3d"),
    }
}

/// The error of a command line, on one line.
pub(crate) fn message(error: &clap::Error) -> String {
    let text = error.to_string();
    let paragraph = text.split("\n\n").next().unwrap_or_default();
    let lines: Vec<&str> = paragraph.lines().map(str::trim).collect();
    lines.join(" ").trim_start_matches("error: ").to_owned()
}
