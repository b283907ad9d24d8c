//! Measures what streams cost through the server, compared with nginx and a direct connection.
//!
//! This program also runs in place of Webots: it sends each client messages of 1 KiB that contain the time. All
//! processes of a machine share the monotonic clock.

use std::net::{Ipv4Addr, TcpStream};
use std::time::Duration;

use futures_util::future::join_all;
use futures_util::{SinkExt, StreamExt};
use nix::time::{ClockId, clock_gettime};
use procfs::process::{Process, all_processes};
use tokio_tungstenite::tungstenite::Message;

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::{Forge, arm};
use crate::support::program::simulation_server;
use crate::support::webots::Webots;
use crate::support::{SOON, ports};
use crate::web_server::{Kind, WebServer};

/// Number of streams at once, and of messages per second on each.
const STREAMS: usize = 100;
const MESSAGES: u32 = 50;
/// The size of a message, in bytes.
const SIZE: usize = 1024;
/// Limit of the latency of 99 % of the messages beyond that of a direct connection.
const LATER: Duration = Duration::from_millis(2);
/// The environment variable that makes this program run in place of Webots.
const SENDER: &str = "RELAY_SENDER";

/// Whether this process runs in place of Webots.
pub fn is_sender() -> bool {
    std::env::var_os(SENDER).is_some()
}

fn now() -> u64 {
    let time = Duration::from(clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap());
    u64::try_from(time.as_nanos()).unwrap()
}

/// Sends messages to each client on Webots' port; never returns.
pub async fn send() {
    let port = std::env::args()
        .find_map(|word| word.strip_prefix("--port=")?.parse().ok())
        .unwrap();
    let listener = tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .await
        .unwrap();
    loop {
        let (socket, _) = listener.accept().await.unwrap();
        socket.set_nodelay(true).unwrap();
        actix_rt::spawn(async move {
            let Ok(mut client) = tokio_tungstenite::accept_async(socket).await else {
                return;
            };
            // Spreads the messages of the clients over time.
            actix_rt::time::sleep(Duration::from_micros(now() % 20_000)).await;
            let mut ticks = actix_rt::time::interval(Duration::from_secs(1) / MESSAGES);
            let mut message = vec![0; SIZE];
            loop {
                ticks.tick().await;
                message[..8].copy_from_slice(&now().to_be_bytes());
                if client.send(Message::binary(message.clone())).await.is_err() {
                    return;
                }
            }
        });
    }
}

/// Measures each way in turns, and prints the medians.
pub async fn measure(verdict: &mut Verdict, time: Duration, rounds: usize) {
    println!("{STREAMS} streams of {MESSAGES} messages of {SIZE} bytes a second, {time:?} each:");
    let forge = Forge::with_arm();
    let program = std::env::current_exe().unwrap();
    let webots = Webots::script(&format!("{SENDER}=1 exec '{}' \"$@\"", program.display()));
    let builder = simulation_server(&webots.path(), forge.path(), 1)
        .set("isolation", "none")
        .set("streaming", "relay");
    let server = builder.set("hangLimit", 3600).start().await;
    let mut client = Client::start(&server, &arm()).await;
    let relayed = client
        .until("webots:")
        .await
        .replace("webots:", "")
        .replace("localhost", "127.0.0.1");
    actix_rt::spawn(async move { while client.next_within(Duration::MAX).await.is_some() {} });
    let (port, listen) = (server.port + 1, ports::block(1));
    let site = format!(
        "server {{ listen 127.0.0.1:{listen}; location / {{ proxy_pass http://127.0.0.1:{port}; proxy_http_version 1.1; \
         proxy_set_header Upgrade $http_upgrade; proxy_set_header Connection upgrade; proxy_buffering off; \
         proxy_read_timeout 1h; }} }}"
    );
    let nginx = WebServer::start(Kind::Nginx, (listen, listen), &site, SOON).await;
    drop(TcpStream::connect(("127.0.0.1", listen)).unwrap());
    let ways = [
        // The processor time of the simulation server without relayed streams.
        ("direct", format!("ws://127.0.0.1:{port}/"), server.pid()),
        ("nginx", format!("ws://127.0.0.1:{listen}/"), nginx.pid().as_raw()),
        ("relay", relayed, server.pid()),
    ];
    let mut results = [const { Vec::new() }; 3];
    for _ in 0..rounds {
        for ((_, url, process), results) in ways.iter().zip(&mut results) {
            results.push(one(url, *process, time).await);
        }
    }
    let mut medians = Vec::new();
    for ((name, _, _), results) in ways.iter().zip(&mut results) {
        let middle = results.len() / 2;
        results.sort_by_key(|one| one.latency);
        let latency = results[middle].latency;
        results.sort_by(|one, other| one.processor.total_cmp(&other.processor));
        let processor = results[middle].processor;
        println!("  {name:<8} p99 {:>9.3?}, {:>6.2} % of a core", latency, processor);
        medians.push((latency, processor));
    }
    let [direct, nginx, relay] = medians[..] else {
        unreachable!()
    };
    verdict.bound("p99 beside direct", relay.0.saturating_sub(direct.0), LATER);
    verdict.ratio("processor time beside nginx", relay.1 / nginx.1, 1.0);
}

/// Measures one way: the latency of 99 % of the messages, and the processor time of `process` and its children, in
/// percent of a core.
async fn one(url: &str, process: i32, time: Duration) -> Taken {
    let connecting = (0..STREAMS).map(|_| tokio_tungstenite::connect_async(url));
    let sockets: Vec<_> = join_all(connecting)
        .await
        .into_iter()
        .map(|one| one.unwrap().0)
        .collect();
    let (before, begin) = (processor(process), now());
    let reading = sockets.into_iter().map(|mut socket| async move {
        let mut latencies = Vec::new();
        let reading = async {
            while let Some(Ok(message)) = socket.next().await {
                let sent = u64::from_be_bytes(message.into_data()[..8].try_into().unwrap());
                // Messages from before all were connected do not count.
                if sent > begin {
                    latencies.push(now().saturating_sub(sent));
                }
            }
        };
        actix_rt::time::timeout(time, reading)
            .await
            .expect_err("a stream has ended");
        latencies
    });
    let mut latencies: Vec<u64> = join_all(reading).await.concat();
    let processor = (processor(process) - before) / time.as_secs_f64() * 100.0;
    let least = STREAMS as f64 * f64::from(MESSAGES) * time.as_secs_f64() * 0.9;
    assert!(latencies.len() as f64 > least, "{} messages came", latencies.len());
    let place = latencies.len() * 99 / 100;
    let latency = Duration::from_nanos(*latencies.select_nth_unstable(place).1);
    Taken { latency, processor }
}

struct Taken {
    latency: Duration,
    processor: f64,
}

/// The processor time of a process and its children so far, in seconds.
fn processor(process: i32) -> f64 {
    let of = |one: Process| {
        one.stat()
            .ok()
            .filter(|stat| stat.pid == process || (stat.ppid == process && stat.comm == "nginx"))
    };
    let ticks: u64 = all_processes()
        .unwrap()
        .flatten()
        .filter_map(of)
        .map(|stat| stat.utime + stat.stime)
        .sum();
    ticks as f64 / procfs::ticks_per_second() as f64
}
