//! Measures how many requests per second the session server answers, compared with a bare handler of actix.

use std::process::Command;

use super::bare::Bare;
use super::goal;
use super::server::Server;
use super::stand_ins::StandIns;

/// The targets take turns, so that other load of the machine affects all of them.
const ROUNDS: usize = 7;
const REFUSED: &str = "/session?url=https://github.com/stranger/arm/blob/main/worlds/arm.wbt";

/// Requests per second, measured by `wrk`.
fn storm(port: u16, path: &str) -> f64 {
    let done = Command::new("wrk")
        .args(["-t1", "-c64", "-d2s", &format!("http://127.0.0.1:{port}{path}")])
        .output()
        .expect("wrk (Debian: apt-get install wrk)");
    let text = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success() && !text.contains("Socket errors"), "{text}");
    let rate = text.lines().find_map(|line| line.strip_prefix("Requests/sec:"));
    rate.and_then(|rate| rate.trim().parse().ok())
        .expect("wrk tells a rate")
}

pub(crate) fn measure() {
    let fleet = StandIns::start(10);
    let server = Server::start(&fleet.addresses);
    let bare = Bare::start();
    let stormed = [
        ("a bare handler of actix", bare.port, "/bare"),
        ("/health", server.port, "/health"),
        ("/session, an answer", server.port, "/session"),
        ("/session, a refusal", server.port, REFUSED),
    ];
    println!("requests a second, 64 connections (wrk -t1 -c64), 10 servers, medians of {ROUNDS} turns:");
    let mut rates = stormed.map(|_| Vec::new());
    for _ in 0..ROUNDS {
        for ((_, port, path), rates) in stormed.iter().zip(&mut rates) {
            rates.push(storm(*port, path));
        }
    }
    let medians = rates.map(|mut rates| {
        rates.sort_unstable_by(f64::total_cmp);
        rates[ROUNDS / 2]
    });
    for ((name, ..), rate) in stormed.iter().zip(medians) {
        println!("  {name:<24} {rate:>7.0}, {:.2} of the bare handler", rate / medians[0]);
    }
    let least = medians[2].min(medians[3]) / medians[0];
    goal(
        "/session, of what a bare handler answers",
        least >= 0.9,
        &format!("{least:.2}, aimed at 0.9"),
    );
}
