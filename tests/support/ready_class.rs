//! A class of 30 that comes within 10 s to two servers with 20 slots each, for a world that needs 8 s to start.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::git::arm;
use super::program::{Builder, Server, session_server};
use super::stopwatch::Stopwatch;

/// Number of the clients.
const CLASS: u32 = 30;
/// Slots of each server.
pub const SLOTS: u16 = 20;
/// The world, with the time that its start takes.
const SLOW: &str = "#VRML_SIM R2025a utf8\n#demo-simulator: load=8\nWorldInfo { }\n";
/// Timeout until all are ready: two at a time start at each server, and the first one may build an image.
const PREPARED: Duration = Duration::from_mins(10);
/// On a quiet machine this process waits for a processor for less than this share of the time.
const QUIET: f64 = 0.1;
const SECRET: &str = "a secret of this test";

/// The seconds that clients waited until simulated time passed.
#[derive(Debug)]
pub struct Waits {
    pub median: f64,
    /// With 30 clients also the 99th percentile.
    pub longest: f64,
    /// The share of the time in which this process waited for a processor.
    held_up: f64,
}

/// Two servers, and the session server that has them keep the whole class ready, or nothing.
pub struct ReadyFleet {
    servers: Vec<Server>,
    session: Server,
    count: u32,
}

impl ReadyFleet {
    /// Starts servers that `server` makes.
    pub async fn start(server: impl Fn() -> Builder, is_ready: bool) -> Self {
        let mut servers = Vec::new();
        for _ in 0..2 {
            let builder = server().set("fleetKey", SECRET).set("readyLoad", 1000);
            builder.forge().commit("lab/arm", "main", &[("worlds/a.wbt", SLOW)]);
            servers.push(builder.start().await);
        }
        let addresses: Vec<String> = servers.iter().map(Server::address).collect();
        let count = if is_ready { CLASS } else { 0 };
        let session = session_server(&addresses)
            .set("fleetKey", SECRET)
            .set("loadThreshold", 1000)
            .set("ready", json!([{"world": arm(), "count": count}]));
        Self {
            servers,
            session: session.start().await,
            count,
        }
    }

    /// Waits until all are ready.
    pub async fn prepare(&self) {
        let begin = Instant::now();
        loop {
            let ready = &self.session.status().await["ready"][0];
            if ready["ready"] == self.count {
                return;
            }
            assert!(begin.elapsed() < PREPARED, "{ready:#}");
            actix_rt::time::sleep(Duration::from_millis(200)).await;
        }
    }

    /// Plays the class. Each client takes a simulation that was ready, or none does.
    pub async fn play(&self) -> Waits {
        let folder = tempfile::tempdir().unwrap();
        let stopwatch = Stopwatch::start();
        let lap = stopwatch.lap();
        let times = rehearsed(&self.session, &folder.path().join("visits.json")).await;
        let held_up = lap.held_up().div_duration_f64(lap.wall());
        let taken: usize = self
            .servers
            .iter()
            .map(|server| server.log().matches(": takes it").count())
            .sum();
        assert_eq!(taken, self.count as usize, "clients that have taken one");
        Waits {
            median: times[times.len() / 2],
            longest: times[times.len() - 1],
            held_up,
        }
    }
}

/// The seconds until simulated time passed, sorted.
async fn rehearsed(session: &Server, json: &Path) -> Vec<f64> {
    let clients = CLASS.to_string();
    let world = arm();
    let mut rehearse = tokio::process::Command::new(env!("CARGO_BIN_EXE_rehearse"));
    rehearse
        .arg(session.url(""))
        .args(["--world", &world, "--clients", &clients]);
    rehearse.args(["--over", "10s", "--stay", "2s", "--real-time", "0", "--json"]);
    rehearse.arg(json).kill_on_drop(true);
    let played = actix_rt::time::timeout(Duration::from_mins(4), rehearse.output()).await;
    let played = played.expect("it ends").unwrap();
    assert!(played.status.success(), "{played:?}");
    let report: Value = serde_json::from_str(&std::fs::read_to_string(json).unwrap()).unwrap();
    let visits = report["visits"].as_array().unwrap().iter();
    let mut times: Vec<f64> = visits
        .filter_map(|visit| visit["steps"]["untilRunning"].as_f64())
        .collect();
    times.sort_by(f64::total_cmp);
    assert_eq!(times.len(), CLASS as usize, "{report:#}");
    times
}

/// Plays the class with simulations that are ready, and without, and prints how long it waits.
pub async fn compare(level: &str, server: impl Fn() -> Builder) {
    let mut all = Vec::new();
    for is_ready in [true, false] {
        let fleet = ReadyFleet::start(&server, is_ready).await;
        fleet.prepare().await;
        let waits = fleet.play().await;
        println!("{level}, {} ready: {waits:.2?}", fleet.count);
        all.push(waits);
    }
    let [ready, started] = &all[..] else { unreachable!() };
    assert!(ready.median < 1.0 && started.median > 8.0, "{level}: {all:?}");
    // Beside other programs, clients wait for a processor.
    if ready.held_up < QUIET {
        assert!(ready.median <= 0.3 && ready.longest <= 0.5, "{level}: {ready:?}");
    }
}
