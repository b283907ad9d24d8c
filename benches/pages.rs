//! Measures the cost of pages: rendering the session server's monitor with 1,000 simulation servers, a hundred open
//! pages of either server, at the demo's size and with 1,000 simulation servers, and one client that requests the monitor
//! in a row.
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
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use askama::Template;
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use support::client::{Client, Heard};
use support::git::{Forge, world};
use support::http::PASSWORD;
use support::program::{Server, session_server, simulation_server};
use support::webots::Webots;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use webots_fleet::session::fleet::{
    Answer, FleetStatus, Intake, ServerRecord, ServerState, ServerStatus, StateChange, StateName,
};
use webots_fleet::session::line::LineStatus;
use webots_fleet::session::web::pages::{self, Monitor};
use webots_fleet::shared::domain::ClientUrls;

const SERVERS: u16 = 1000;
const PAGES: usize = 100;
/// Number of simulations on the simulation server whose pages are open.
const SIMULATIONS: u16 = 4;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let seconds = arguments
        .iter()
        .position(|one| one == "--seconds")
        .map_or(20, |at| arguments[at + 1].parse().unwrap());
    rendering();
    let time = Duration::from_secs(seconds);
    actix_rt::System::new().block_on(open_pages(time));
    actix_rt::System::new().block_on(open_pages_of_a_large_fleet(time));
}

fn rendering() {
    let fleet = fleet();
    let urls = ClientUrls {
        ssl: false,
        public: None,
    };
    let render = || {
        let view = pages::view(&fleet, 1000, &urls, "").unwrap();
        Monitor {
            started: String::new(),
            has_actions: true,
            view,
        }
        .render()
        .unwrap()
    };
    let page = render();
    let mut times: Vec<Duration> = (0..50)
        .map(|_| {
            let begun = Instant::now();
            std::hint::black_box(render());
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
    let address = |number: u16| {
        format!("simulation{number}.example.org:{}", 2000 + number)
            .parse()
            .unwrap()
    };
    let servers = (0..SERVERS).map(|number| ServerStatus {
        record: ServerRecord {
            state: ServerState::Answering {
                answer: Answer {
                    report: Arc::new(serde_json::from_value(report.clone()).unwrap()),
                    at: Instant::now(),
                    latency: Duration::from_millis(3),
                },
                intake: if number % 10 == 0 { Intake::Full } else { Intake::Up },
            },
            ..ServerRecord::new(address(number))
        },
        failure: None,
        effective_load: Some(44.5),
        in_flight: 1,
        client_cost: Some(1.0),
    });
    let change = |number| StateChange {
        at: String::new(),
        server: address(number).to_string(),
        state: StateName::Down,
        why: "no answer within 3 s".to_owned(),
    };
    let changes: VecDeque<StateChange> = (0..50).map(change).collect();
    FleetStatus {
        available: true,
        mean_load: Some(42.5),
        servers: servers.collect(),
        names: Vec::new(),
        changes,
        ready: Vec::new(),
        requested: Vec::new(),
        line: LineStatus::default(),
    }
}

/// The demo's size: three simulation servers, one of which runs simulations that clients watch.
async fn open_pages(time: Duration) {
    let forge = Forge::with_arm();
    let webots = Webots::launcher();
    let mut fleet = Vec::new();
    for _ in 0..3 {
        fleet.push(
            simulation_server(&webots.path(), forge.path(), SIMULATIONS)
                .set("adminPassword", PASSWORD)
                .start()
                .await,
        );
    }
    let addresses: Vec<String> = fleet.iter().map(Server::address).collect();
    let session = session_server(&addresses).set("loadRefresh", 1).start().await;
    let mut clients = Vec::new();
    for _ in 0..SIMULATIONS {
        let mut client = Client::start(&fleet[0], &world("lab/arm", "main", "worlds/a.wbt")).await;
        let simulator = client
            .until("webots:")
            .await
            .replace("webots:", "")
            .replace("localhost", "127.0.0.1");
        let mut viewer = Client::connect(&format!("{simulator}/")).await;
        viewer.send("w3d").await;
        viewer.until("scene load completed").await;
        viewer.send("real-time:-1").await;
        actix_rt::spawn(async move { while let Heard::Text(_) = viewer.next().await {} });
        clients.push(client);
    }
    compare("session server", &session, time).await;
    compare("simulation server", &fleet[0], time).await;
    let administrator = format!(
        "Authorization: Basic {}\r\n",
        BASE64_STANDARD.encode(format!("admin:{PASSWORD}"))
    );
    for (name, path, headers) in [
        ("/health", "/health", ""),
        ("the monitor", "/monitor", ""),
        // For administrators it is rendered for each request, as it was for all.
        ("the monitor, as administrator", "/monitor", administrator.as_str()),
    ] {
        in_a_row(&format!("simulation server, {name}"), &fleet[0], path, headers, time).await;
    }
}

/// A session server with many simulation servers whose loads change all the time.
async fn open_pages_of_a_large_fleet(time: Duration) {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
    let mut addresses = Vec::new();
    for number in 0..SERVERS {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        addresses.push(listener.local_addr().unwrap().to_string());
        actix_rt::spawn(answer(listener, number));
    }
    let session = session_server(&addresses).set("loadRefresh", 1).start().await;
    compare(&format!("session server with {SERVERS} servers"), &session, time).await;
    let name = format!("session server with {SERVERS} servers, the monitor");
    in_a_row(&name, &session, "/monitor", "", time).await;
}

/// A stand-in for a simulation server, which reports a different load each time.
async fn answer(listener: tokio::net::TcpListener, number: u16) {
    let (mut stream, _) = listener.accept().await.unwrap();
    let mut request = [0; 2048];
    // A request is small enough to arrive in one piece.
    for turn in 0.. {
        if stream.read(&mut request).await.unwrap_or_default() == 0 {
            return;
        }
        let load = (u32::from(number) + turn * 7) % 90;
        let body = format!(
            r#"{{"load":{load},"version":"1","instances":{{"queued":0,"starting":1,"idle":2,"running":3,"places":10,"arrivals":6}},"docker":false,"allowedRepositories":["https://github.com/lab"]}}"#
        );
        let answer = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{body}", body.len());
        if stream.write_all(answer.as_bytes()).await.is_err() {
            return;
        }
    }
}

/// Compares the processor time of a server without and with open pages.
async fn compare(name: &str, server: &Server, time: Duration) {
    let alone = used(server, time).await;
    let pages: Vec<Listener> = (0..PAGES).map(|_| Listener::open(server.port)).collect();
    // Each page first receives everything.
    actix_rt::time::sleep(Duration::from_secs(5)).await;
    let with_pages = used(server, time).await;
    let heard: Vec<Received> = pages.into_iter().map(Listener::heard).collect();
    let events: usize = heard.iter().map(|one| one.events).sum();
    let bytes: usize = heard.iter().map(|one| one.bytes).sum();
    println!(
        "{name}: {alone:.2} % of a core without pages, {with_pages:.2} % with {PAGES}: {:.2} % more, {} events and {} KiB each",
        with_pages - alone,
        events / PAGES,
        bytes / PAGES / 1024
    );
}

/// Measures what one client costs that requests a page again and again on one connection.
async fn in_a_row(name: &str, server: &Server, path: &str, headers: &str, time: Duration) {
    let alone = used(server, time).await;
    let port = server.port;
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n{headers}\r\n");
    let client = std::thread::spawn(move || request_in_a_row(port, &request, time));
    let with_client = used(server, time).await;
    let (answers, bytes) = client.join().unwrap();
    println!(
        "{name}, requested in a row: {:.2} % of a core more, {:.0} answers and {:.2} MB a second",
        with_client - alone,
        answers as f64 / time.as_secs_f64(),
        bytes as f64 / time.as_secs_f64() / 1e6
    );
}

/// Sends a request once the answer to the last one has arrived. Returns the number of answers, and of their bytes.
fn request_in_a_row(port: u16, request: &str, time: Duration) -> (usize, usize) {
    let mut stream = BufReader::new(TcpStream::connect(("127.0.0.1", port)).unwrap());
    let begun = Instant::now();
    let (mut answers, mut bytes) = (0, 0);
    while begun.elapsed() < time {
        stream.get_mut().write_all(request.as_bytes()).unwrap();
        let mut length = 0;
        let mut line = String::new();
        while line != "\r\n" {
            line.clear();
            bytes += stream.read_line(&mut line).unwrap();
            assert!(
                answers > 0 || bytes > line.len() || line.starts_with("HTTP/1.1 200 "),
                "{line}"
            );
            if let Some(text) = line.to_ascii_lowercase().strip_prefix("content-length:") {
                length = text.trim().parse().unwrap();
            }
        }
        stream.read_exact(&mut vec![0; length]).unwrap();
        bytes += length;
        answers += 1;
    }
    (answers, bytes)
}

/// The processor time of a server during `time`, in percent of one core.
async fn used(server: &Server, time: Duration) -> f64 {
    let ticks = || {
        let stat = procfs::process::Process::new(server.pid()).unwrap().stat().unwrap();
        (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
    };
    let before = ticks();
    let begun = Instant::now();
    actix_rt::time::sleep(time).await;
    100.0 * (ticks() - before) / begun.elapsed().as_secs_f64()
}

/// An open page: a thread reads everything that arrives.
struct Listener {
    socket: TcpStream,
    reader: std::thread::JoinHandle<Received>,
}

/// What a page has received.
#[derive(Default)]
struct Received {
    events: usize,
    bytes: usize,
}

impl Listener {
    fn open(port: u16) -> Self {
        let mut socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
        write!(socket, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        let mut stream = socket.try_clone().unwrap();
        let reader = std::thread::spawn(move || {
            let mut received = Received::default();
            let mut buffer = [0; 64 * 1024];
            while let Ok(count @ 1..) = stream.read(&mut buffer) {
                received.bytes += count;
                // An event is one chunk. A read ends with it, unless the next event arrives at the same moment.
                received.events += usize::from(buffer[..count].ends_with(b"\n\n\r\n"));
            }
            received
        });
        Self { socket, reader }
    }

    fn heard(self) -> Received {
        self.socket.shutdown(std::net::Shutdown::Both).unwrap();
        self.reader.join().unwrap()
    }
}
