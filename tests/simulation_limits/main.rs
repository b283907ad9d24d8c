//! The time limit of a simulation. A configuration file can't ask for less than six minutes, so that this program
//! runs the server itself, with a shorter one. It has a `main` of its own because the server starts its own program
//! as guardian of each Webots.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests fail by panics"
)]
#![allow(clippy::pedantic, reason = "tests are read one by one")]

#[path = "../support/mod.rs"]
mod support;

use std::time::{Duration, Instant};

use clap::Parser;
use support::client::Client;
use support::git::{Forge, world};
use support::webots::{Webots, instances_below};
use webots_fleet::shared::config;
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::{app, guardian};

#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    part: Part,
}

#[derive(clap::Subcommand)]
enum Part {
    Guard(guardian::Orders),
}

fn main() {
    if std::env::args().nth(1).as_deref() == Some("guard") {
        let Part::Guard(orders) = Arguments::parse().part;
        std::process::exit(guardian::guard(&orders).into());
    }
    actix_rt::System::new().block_on(a_simulation_ends_at_its_time_limit());
    println!("a_simulation_ends_at_its_time_limit ... ok");
}

async fn a_simulation_ends_at_its_time_limit() {
    let (forge, webots, folder) = (Forge::with_arm(), Webots::launcher(), tempfile::tempdir().unwrap());
    let port = support::ports::block(12);
    let file = folder.path().join("config.json");
    let text = serde_json::json!({
        "server": "localhost", "ssl": false, "portRewrite": false, "bind": "127.0.0.1", "port": port,
        "webots": webots.path(), "maxConnections": 1, "allowedRepositories": "https://github.com/lab",
        "gitMirrors": {"https://github.com/": format!("file:{}", forge.path().display())},
        "logDir": folder.path().join("log"), "cacheDir": folder.path().join("cache"),
    });
    std::fs::write(&file, text.to_string()).unwrap();
    let mut config = config::load::<SimulationConfig>(&file).unwrap().config;
    config.timeout = 2;
    let server = actix_rt::spawn(app::run(config));
    let url = format!("ws://127.0.0.1:{port}/client");
    support::until("the server listens", async || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok()).await;
    let begin = Instant::now();
    let mut client = Client::connect(&url).await;
    let start = serde_json::json!({"start": {"url": world("lab/arm", "main", "worlds/a.wbt")}});
    client.send(&start.to_string()).await;
    assert_eq!(client.until("shutdownTimeout").await, "shutdownTimeout: 2");
    client.until("webots:").await;
    let told = client.until("loading: Error:").await;
    assert!(told.starts_with("loading: Error: The time limit of 2 seconds was reached"), "{told}");
    assert_eq!(client.closed().await, Some(1000));
    assert!(begin.elapsed() >= Duration::from_secs(2), "it came too early");
    assert_eq!(instances_below(folder.path()), []);
    nix::sys::signal::kill(nix::unistd::Pid::this(), nix::sys::signal::Signal::SIGTERM).unwrap();
    server.await.unwrap().unwrap();
    assert_eq!(std::fs::read_dir(folder.path().join("cache/runs")).unwrap().count(), 0);
}
