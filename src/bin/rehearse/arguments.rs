//! The command line of the program.

use std::path::PathBuf;
use std::time::Duration;

use clap::Parser;
use url::Url;
use webots_fleet::shared::run::raise_open_files;

use crate::behaviour::Mix;
use crate::localhost::is_localhost;
use crate::stay::{Stay, time};

/// Open files that one client needs (its connections), and those that the program itself needs.
const FILES: (u64, u64) = (4, 64);

/// Runs a class of web clients against a fleet, and reports how many fit.
///
/// It speaks to a session server as Webots' web page does: availability, a simulation server, the start, the scene and its
/// updates, run, leave. Exit code 0: as many as expected; 1: fewer, or nothing could be measured; 2: wrong arguments, or --yes is missing;
/// 130: Ctrl-C or SIGTERM.
#[derive(Parser, Debug, Clone)]
#[command(version)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is an independent switch of the command line"
)]
pub(crate) struct Arguments {
    /// The session server
    #[arg(value_name = "http://HOST:PORT", value_parser = fleet)]
    pub(crate) fleet: Url,
    /// The world that all clients start
    #[arg(long, value_name = "https://github.com/USER/REPOSITORY/blob/BRANCH/worlds/NAME.wbt")]
    pub(crate) world: String,
    /// Number of clients
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) clients: u32,
    /// Time over which the clients arrive, at regular intervals; 0s: all at once
    #[arg(long, default_value = "60s", value_parser = time)]
    pub(crate) over: Duration,
    /// Time for which each client stays once its simulation runs, or two between which it is drawn: 5s..15s
    #[arg(long, default_value = "2m", value_parser = str::parse::<Stay>)]
    pub(crate) stay: Stay,
    /// Wait for a simulation server in the session server's line, as its page /viewer does, instead of asking again and again
    #[arg(long)]
    pub(crate) line: bool,
    /// Time after which a client gives up if its simulation does not run
    #[arg(long, default_value = "5m", value_parser = time)]
    pub(crate) patience: Duration,
    /// Shares of clients that misbehave, in percent: reload, return (reload and resume), drop (leave without closing), sleep (a tab that reads nothing),
    /// vanish (a lost network connection), hasty (start and leave at once). Example: reload=10,vanish=5
    #[arg(long, default_value = "", value_parser = str::parse::<Mix>)]
    pub(crate) misbehave: Mix,
    /// Repeat visits for this time, instead of one visit per client
    #[arg(long, value_parser = time)]
    pub(crate) soak: Option<Duration>,
    /// Least share of real time at which a simulation counts as one that fits
    #[arg(long, default_value_t = 0.9, value_parser = share)]
    pub(crate) real_time: f64,
    /// Number of clients that must fit for exit code 0
    #[arg(long, value_name = "CLIENTS")]
    pub(crate) expect: Option<u32>,
    /// File for the results as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Format that the viewer requests from Webots: w3d (R2025a), x3d (up to R2023b)
    #[arg(long, default_value = "w3d", value_parser = ["w3d", "x3d"])]
    pub(crate) viewer: String,
    /// Take one client through all steps, and compare each message with what a fleet and Webots should send
    #[arg(long, conflicts_with_all = ["clients", "over", "stay", "line", "real_time", "misbehave", "soak", "expect", "json"])]
    pub(crate) explain: bool,
    /// Let the clients come one after the other and stay, until simulations are slower than real time: how many fit on each server
    #[arg(long, conflicts_with_all = ["over", "stay", "line", "misbehave", "soak", "json", "explain"])]
    pub(crate) find: bool,
    /// Allow a fleet that is not on this machine
    #[arg(long)]
    pub(crate) yes: bool,
}

impl Arguments {
    /// Checks before the start that this machine can do what is requested.
    ///
    /// # Errors
    /// What can't be done, as text.
    pub(crate) fn prepare(&self) -> Result<(), String> {
        if !self.fleet.username().is_empty() || self.fleet.password().is_some() {
            return Err(
                "the session server's URL has a user name or a password, which nobody would be sent".to_owned(),
            );
        }
        if !self.yes && !is_localhost(&self.fleet) {
            return Err(format!(
                "{} is not this machine: --yes loads it with {}",
                self.fleet,
                self.summary()
            ));
        }
        let clients = if self.explain { 1 } else { self.clients };
        let needed = u64::from(clients) * FILES.0 + FILES.1;
        let allowed = raise_open_files(needed);
        if allowed < needed {
            return Err(format!(
                "{clients} clients need {needed} open files, and the system allows {allowed} (ulimit -Hn)"
            ));
        }
        let Some(file) = &self.json else { return Ok(()) };
        let opened = std::fs::OpenOptions::new().create(true).append(true).open(file);
        opened
            .map(drop)
            .map_err(|error| format!("{} can't be written: {error}", file.display()))
    }

    /// A summary of the rehearsal: `200 clients within 1m, each for 10m`.
    pub(crate) fn summary(&self) -> String {
        if self.explain {
            return "one client".to_owned();
        }
        if self.find {
            return format!("up to {} clients, one after the other", self.clients);
        }
        let words = |time| humantime::format_duration(time).to_string();
        let how_long = self
            .soak
            .map(|soak| format!(", again and again for {}", words(soak)))
            .unwrap_or_default();
        let over = if self.over.is_zero() {
            "at once".to_owned()
        } else {
            format!("within {}", words(self.over))
        };
        format!(
            "{} clients {over}, each for {}{how_long}{}",
            self.clients,
            self.stay,
            if self.line { ", in the line" } else { "" }
        )
    }
}

fn fleet(text: &str) -> Result<Url, String> {
    let url = Url::parse(text).map_err(|error| error.to_string())?;
    let is_usable = matches!(url.scheme(), "http" | "https") && url.has_host();
    if is_usable {
        Ok(url)
    } else {
        Err("allowed is http://HOST:PORT or https://HOST".to_owned())
    }
}

fn share(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|share| (0.0..=1.0).contains(share))
        .ok_or_else(|| "allowed is 0 to 1".to_owned())
}
