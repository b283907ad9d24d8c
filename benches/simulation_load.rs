//! How fast `/load` answers while ten checkouts run, one remote hangs, and a simulator floods its output.
//!
//! `cargo bench --bench simulation_load [-- --requests N]`

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

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use support::client::Client;
use support::git::{Forge, world};
use support::program::simulation_server;
use support::webots::Webots;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let requests =
        arguments.iter().position(|one| one == "--requests").map_or(2000, |at| arguments[at + 1].parse().unwrap());
    actix_rt::System::new().block_on(measure(requests));
}

async fn measure(requests: usize) {
    let forge = Forge::new();
    for n in 0..10 {
        let text = "#VRML_SIM R2025a utf8\nWorldInfo { }\n";
        let name = format!("lab/r{n}");
        let work = forge.work_tree(&name, "main");
        std::fs::create_dir_all(work.join("worlds")).unwrap();
        std::fs::write(work.join("worlds/a.wbt"), text).unwrap();
        for file in 0..500 {
            std::fs::write(work.join(format!("file{file}")), format!("{n} {file}").repeat(500)).unwrap();
        }
        forge.commit_work_tree(&name, "main");
    }
    let demo = env!("CARGO_BIN_EXE_demo-simulator");
    let webots =
        Webots::script(&format!("case \"$*\" in *--port=*1) yes flood & ;; esac\n{demo} \"$@\" >/dev/null & wait"));
    let hanging = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mirrors = serde_json::json!({
        "https://github.com/": format!("file:{}", forge.path().display()),
        "https://github.com/lab/hangs": format!("https://127.0.0.1:{}/", hanging.local_addr().unwrap().port()),
    });
    let server = simulation_server(&webots.path(), forge.path(), 12).set("gitMirrors", mirrors).start().await;
    report("idle", &ask(server.port, requests).await);
    let _stuck = Client::start(&server, &world("lab/hangs", "main", "worlds/a.wbt")).await;
    let mut clients = Vec::new();
    for n in 0..10 {
        clients.push(Client::start(&server, &world(&format!("lab/r{n}"), "main", "worlds/a.wbt")).await);
    }
    report("ten checkouts, one hangs", &ask(server.port, requests).await);
    for client in &mut clients {
        client.until("webots:").await;
    }
    let flood = Webots::script(&format!("{demo} \"$@\" >/dev/null &\nyes flood & wait"));
    let flooded = simulation_server(&flood.path(), forge.path(), 1).start().await;
    let mut client = Client::start(&flooded, &world("lab/r0", "main", "worlds/a.wbt")).await;
    client.until("webots:").await;
    report("a flood of output", &ask(flooded.port, requests).await);
}

/// Times of requests on one open connection, as a session server asks.
async fn ask(port: u16, requests: usize) -> Vec<Duration> {
    actix_rt::task::spawn_blocking(move || {
        let mut socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
        socket.set_nodelay(true).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut answer = [0; 4096];
        let mut times: Vec<Duration> = (0..requests)
            .map(|_| {
                let begin = Instant::now();
                socket.write_all(b"GET /load HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
                let length = socket.read(&mut answer).unwrap();
                assert!(answer[..length].starts_with(b"HTTP/1.1 200"));
                let time = begin.elapsed();
                std::thread::sleep(Duration::from_micros(500));
                time
            })
            .collect();
        times.sort();
        times
    })
    .await
    .unwrap()
}

fn report(what: &str, times: &[Duration]) {
    let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
    println!("{what:<26} median {:>9.3?}  p99 {:>9.3?}  worst {:>9.3?}", at(0.5), at(0.99), at(1.0));
}
