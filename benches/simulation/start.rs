//! Measures what a cached start costs beyond its git commands, and what a sandbox adds to it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::{Forge, WORLD, world};
use crate::support::program::simulation_server;
use crate::support::webots::Webots;

/// Limit of the time beyond that of git, and of that for a sandbox.
const BOUND: Duration = Duration::from_millis(10);
/// Limit of the time from the readiness of a world to the URL.
const LATENESS: Duration = Duration::from_millis(50);

pub async fn measure(verdict: &mut Verdict, starts: usize) {
    let forge = Forge::with_arm();
    // Ends at once: only the time until the end of the checkout counts.
    let webots = Webots::script("exit 0");
    let server = simulation_server(&webots.path(), forge.path(), 4).start().await;
    let url = world("lab/arm", "main", "worlds/a.wbt");
    let mut ours = Vec::new();
    let mut plain = Vec::new();
    checkout(&server, &url).await;
    for _ in 0..starts {
        ours.push(checkout(&server, &url).await);
        plain.push(commands(
            &server.folder.join("cache/git"),
            &forge.path().join("lab/arm"),
        ));
    }
    let ours = median(ours);
    let plain = median(plain);
    println!("cached start, from the wish to the end of the checkout: {ours:.1?} (median of {starts})");
    println!("the same three git commands by themselves:              {plain:.1?}");
    let over = ours.saturating_sub(plain);
    println!("  {:.2} times as long", ours.as_secs_f64() / plain.as_secs_f64());
    verdict.bound("over git", over, BOUND);
}

/// Measures how much later than its world is ready a client receives the URL of its Webots, for worlds that are
/// downloaded, read, or both.
pub async fn follow_loads(verdict: &mut Verdict, starts: usize) {
    for level in ["none", "sandbox"] {
        for options in ["download=0.3", "load=0.3", "download=0.3 load=0.3"] {
            let forge = Forge::with_arm();
            let world = WORLD.replacen('\n', &format!("\n#demo-simulator: {options}\n"), 1);
            forge.commit("lab/arm", "slow", &[("worlds/a.wbt", &world)]);
            let webots = Webots::launcher();
            let server = simulation_server(&webots.path(), forge.path(), 1)
                .set("isolation", level)
                .start()
                .await;
            let mut late = Vec::new();
            for _ in 0..starts {
                late.push(lateness(&server).await);
            }
            let worst = late.iter().max().copied().unwrap_or_default();
            println!(
                "{level}, {options}: the URL comes {:.1?} after readiness (median of {starts}), at most {worst:.1?}",
                median(late)
            );
            verdict.bound("after readiness, at most", worst, LATENESS);
        }
    }
}

/// The time from the readiness of a world, which a thread of its own sees, to the URL.
async fn lateness(server: &crate::support::program::Server) -> Duration {
    let mut client = Client::start(server, &world("lab/arm", "slow", "worlds/a.wbt")).await;
    client.until("loading: webots is starting").await;
    let port = server.port + 1;
    let ready = std::thread::spawn(move || {
        while !is_ready(port) {
            std::thread::sleep(Duration::from_millis(1));
        }
        Instant::now()
    });
    client.until("webots:").await;
    let told = Instant::now();
    let late = told.saturating_duration_since(ready.join().unwrap());
    client.close_with(1000).await;
    late
}

/// Whether the Webots at this port has a world; waits while it reads one.
fn is_ready(port: u16) -> bool {
    let Ok(mut stream) = TcpStream::connect(("127.0.0.1", port)) else {
        return false;
    };
    let mut answer = [0; 6];
    stream.write_all(b"CTR\nRobot-Name: %2F\n\n").is_ok()
        && stream.read_exact(&mut answer).is_ok()
        && answer == *b"FAILED"
}

/// Measures how much longer a program takes from its launch to its end in a sandbox.
pub async fn compare_levels(verdict: &mut Verdict, starts: usize) {
    let forge = Forge::with_arm();
    let at = |level: &str| {
        simulation_server(Path::new("/bin/true"), forge.path(), 4)
            .set("isolation", level)
            .start()
    };
    let none = at("none").await;
    let sandbox = at("sandbox").await;
    let url = world("lab/arm", "main", "worlds/a.wbt");
    let mut without = Vec::new();
    let mut within = Vec::new();
    for _ in 0..starts {
        without.push(launch(&none, &url).await);
        within.push(launch(&sandbox, &url).await);
    }
    let without = median(without);
    let within = median(within);
    println!("a program that does nothing, from its launch to its end: {without:.1?}, in a sandbox {within:.1?}");
    verdict.bound("for the sandbox", within.saturating_sub(without), BOUND);
}

async fn launch(server: &crate::support::program::Server, url: &str) -> Duration {
    let mut client = Client::start(server, url).await;
    client.until("loading: webots is starting").await;
    let begin = Instant::now();
    client.until("loading: Webots has ended").await;
    let time = begin.elapsed();
    client.closed().await;
    time
}

async fn checkout(server: &crate::support::program::Server, url: &str) -> Duration {
    let mut client = Client::connect(&server.websocket("/client")).await;
    let begin = Instant::now();
    client
        .send(&serde_json::json!({"start": {"url": url}}).to_string())
        .await;
    client.until("loading: checkout done").await;
    let time = begin.elapsed();
    client.closed().await;
    time
}

fn commands(cache: &Path, remote: &Path) -> Duration {
    let entries = std::fs::read_dir(cache).unwrap().flatten().map(|entry| entry.path());
    let repository = entries.into_iter().find(|path| path.is_dir()).unwrap();
    let fleet = std::fs::read_dir(repository.join("refs/fleet"))
        .unwrap()
        .flatten()
        .next()
        .unwrap();
    let reference = format!("refs/fleet/{}", fleet.file_name().to_str().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let status = Command::new("git")
            .arg("--git-dir")
            .arg(&repository)
            .args(arguments)
            .env("GIT_INDEX_FILE", folder.path().join("index"))
            .env("GIT_CONFIG_GLOBAL", "/dev/null")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status();
        assert!(status.unwrap().success(), "{arguments:?}");
    };
    std::fs::create_dir(folder.path().join("project")).unwrap();
    let tree = format!("--work-tree={}", folder.path().join("project").display());
    let begin = Instant::now();
    run(&[
        "ls-remote",
        "--quiet",
        "--",
        remote.to_str().unwrap(),
        "refs/heads/main",
        "refs/tags/main",
    ]);
    run(&["ls-tree", "-r", "-l", "-z", "--full-tree", &reference]);
    run(&[&tree, "checkout", "--force", "--progress", &reference, "--", "."]);
    begin.elapsed()
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() / 2]
}
