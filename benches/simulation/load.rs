//! Measures how fast `/load` answers while ten checkouts run, one remote hangs, and a simulator floods its output.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::{Forge, world};
use crate::support::program::simulation_server;
use crate::support::webots::Webots;

/// Limit of the time of an answer, whatever else the server does.
const BOUND: Duration = Duration::from_millis(1);

pub async fn measure(verdict: &mut Verdict, requests: usize) {
    println!("/load, {requests} requests in a row:");
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
    let webots = Webots::script(&format!(
        "case \"$*\" in *--port=*1) yes flood & ;; esac\n{demo} \"$@\" >/dev/null & wait"
    ));
    let hanging = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mirrors = serde_json::json!({
        "https://github.com/": format!("file:{}", forge.path().display()),
        "https://github.com/lab/hangs": format!("https://127.0.0.1:{}/", hanging.local_addr().unwrap().port()),
    });
    let server = simulation_server(&webots.path(), forge.path(), 12)
        .set("gitMirrors", mirrors)
        .start()
        .await;
    report(verdict, "idle", &ask(server.port, requests).await);
    let _stuck = Client::start(&server, &world("lab/hangs", "main", "worlds/a.wbt")).await;
    let mut clients = Vec::new();
    for n in 0..10 {
        clients.push(Client::start(&server, &world(&format!("lab/r{n}"), "main", "worlds/a.wbt")).await);
    }
    report(verdict, "ten checkouts, one hangs", &ask(server.port, requests).await);
    for client in &mut clients {
        client.until("webots:").await;
    }
    let flood = Webots::script(&format!("{demo} \"$@\" >/dev/null &\nyes flood & wait"));
    let flooded = simulation_server(&flood.path(), forge.path(), 1).start().await;
    let mut client = Client::start(&flooded, &world("lab/r0", "main", "worlds/a.wbt")).await;
    client.until("webots:").await;
    report(verdict, "a flood of output", &ask(flooded.port, requests).await);
}

/// Times of requests on one open connection, as a session server sends them.
async fn ask(port: u16, requests: usize) -> Vec<Duration> {
    actix_rt::task::spawn_blocking(move || {
        let mut socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
        socket.set_nodelay(true).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut answer = [0; 4096];
        let mut times: Vec<Duration> = (0..requests)
            .map(|_| {
                let begin = Instant::now();
                socket
                    .write_all(b"GET /load HTTP/1.1\r\nHost: localhost\r\n\r\n")
                    .unwrap();
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

fn report(verdict: &mut Verdict, what: &str, times: &[Duration]) {
    let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
    println!(
        "  {what:<26} median {:>9.3?}  p99 {:>9.3?}  worst {:>9.3?}",
        at(0.5),
        at(0.99),
        at(1.0)
    );
    verdict.bound("p99", at(0.99), BOUND);
}
