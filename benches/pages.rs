//! What pages cost: rendering the session server's monitor with 1,000 simulation servers, and a hundred open pages.
//!
//! `cargo bench --bench pages [-- --seconds N]`

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a measurement that fails ends with a panic"
)]

#[path = "../tests/support/mod.rs"]
mod support;

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant, SystemTime};

use support::git::Forge;
use support::program::{Server, session_server, simulation_server};
use support::webots::Webots;
use webots_fleet::session::fleet_status::{FleetStatus, ServerStatus, State, StateChange};
use webots_fleet::session::pages;

const SERVERS: u16 = 1000;
const PAGES: usize = 100;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let seconds =
        arguments.iter().position(|one| one == "--seconds").map_or(20, |at| arguments[at + 1].parse().unwrap());
    rendering();
    actix_rt::System::new().block_on(open_pages(Duration::from_secs(seconds)));
}

fn rendering() {
    let fleet = fleet();
    let page = pages::monitor(&fleet, 1000, false, SystemTime::now()).unwrap();
    let mut times: Vec<Duration> = (0..50)
        .map(|_| {
            let begun = Instant::now();
            std::hint::black_box(pages::monitor(&fleet, 1000, false, SystemTime::now()).unwrap());
            begun.elapsed()
        })
        .collect();
    times.sort();
    println!(
        "a page with {SERVERS} servers, {} KiB: median {:?}, slowest {:?}",
        page.len() / 1024,
        times[25],
        times[49]
    );
}

fn fleet() -> FleetStatus {
    let report = serde_json::json!({
        "load": 42.5, "version": "0.1.0", "docker": false,
        "instances": {"queued": 1, "starting": 2, "idle": 3, "running": 40, "places": 100, "arrivals": 1000},
        "allowedRepositories": ["https://github.com/lab", "https://github.com/school/robots"],
    });
    let address = |number: u16| format!("simulation{number}.example.org:{}", 2000 + number).parse().unwrap();
    let servers = (0..SERVERS).map(|number| ServerStatus {
        address: address(number),
        state: if number % 10 == 0 { State::Full } else { State::Up },
        since: SystemTime::now(),
        report: Some(serde_json::from_value(report.clone()).unwrap()),
        error: None,
        effective_load: Some(44.5),
        in_flight: 1,
        client_cost: Some(1.0),
        latency: Some(Duration::from_millis(3)),
        answered: Some(Instant::now()),
    });
    let change = |number| StateChange {
        at: SystemTime::now(),
        server: address(number),
        state: State::Down,
        why: "no answer within 3 s".to_owned(),
    };
    let changes: VecDeque<StateChange> = (0..50).map(change).collect();
    FleetStatus { available: true, mean_load: Some(42.5), servers: servers.collect(), changes }
}

async fn open_pages(time: Duration) {
    let (forge, webots) = (Forge::new(), Webots::script("exit 0"));
    let mut fleet = Vec::new();
    for _ in 0..3 {
        fleet.push(simulation_server(&webots.path(), forge.path(), 4).start().await);
    }
    let addresses: Vec<String> = fleet.iter().map(Server::address).collect();
    let session = session_server(&addresses).set("loadRefresh", 1).start().await;
    for (name, server) in [("session", &session), ("simulation", &fleet[0])] {
        let alone = used(server, time).await;
        let pages: Vec<Listener> = (0..PAGES).map(|_| Listener::open(server.port)).collect();
        let with_pages = used(server, time).await;
        let events: usize = pages.into_iter().map(Listener::events).sum();
        println!(
            "{name} server: {alone:.2} % of a core without pages, {with_pages:.2} % with {PAGES}: {:.2} % more, {} events each",
            with_pages - alone,
            events / PAGES
        );
    }
}

/// The CPU that a server takes in a time, in percent of one core.
async fn used(server: &Server, time: Duration) -> f64 {
    let ticks = || {
        let stat = procfs::process::Process::new(server.pid()).unwrap().stat().unwrap();
        (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
    };
    let (before, begun) = (ticks(), Instant::now());
    actix_rt::time::sleep(time).await;
    100.0 * (ticks() - before) / begun.elapsed().as_secs_f64()
}

/// A page that listens: a thread reads all that comes.
struct Listener {
    socket: TcpStream,
    reader: std::thread::JoinHandle<usize>,
}

impl Listener {
    fn open(port: u16) -> Self {
        let mut socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
        write!(socket, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        let mut stream = socket.try_clone().unwrap();
        let reader = std::thread::spawn(move || {
            let (mut events, mut buffer) = (0, [0; 16 * 1024]);
            while let Ok(count @ 1..) = stream.read(&mut buffer) {
                events += buffer[..count].windows(6).filter(|window| window == b"data: ").count();
            }
            events
        });
        Self { socket, reader }
    }

    fn events(self) -> usize {
        self.socket.shutdown(std::net::Shutdown::Both).unwrap();
        self.reader.join().unwrap()
    }
}
