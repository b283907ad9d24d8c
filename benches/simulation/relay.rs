//! Measures what streams cost through the server, compared with nginx and a direct connection: many slow ones, and one
//! that sends back what it receives beside a few that are as fast as possible.
//!
//! This program also runs in place of Webots: it sends each client messages of 1 KiB that contain the time. All
//! processes of a machine share the monotonic clock.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use futures_util::{SinkExt, StreamExt};
use nix::time::{ClockId, clock_gettime};
use procfs::process::{Process, all_processes};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_tungstenite::tungstenite::stream::MaybeTlsStream;
use tokio_tungstenite::tungstenite::{self, Message};

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::{Forge, arm};
use crate::support::program::{Server, simulation_server};
use crate::support::webots::Webots;
use crate::support::{SOON, ports};
use crate::web_server::{Kind, WebServer};

/// Number of simulations.
const SIMULATIONS: u16 = 13;
/// Number of streams at once, and of messages per second on each.
const STREAMS: usize = 100;
const MESSAGES: u32 = 50;
/// Number of streams that are as fast as possible, beside one that sends back what it receives.
const FAST: usize = 6;
/// The interval between two messages that are sent back, and their size in bytes.
const PERIOD: Duration = Duration::from_millis(5);
const ECHO: usize = 300;
/// Limit of the latency of 99 % of these messages, compared with nginx.
const ECHO_BESIDE_NGINX: f64 = 3.0;
/// The size of a message, in bytes.
const SIZE: usize = 1024;
/// Limit of the latency of 99 % of the messages beyond that of a direct connection.
const LATER: Duration = Duration::from_millis(2);
/// The environment variable that makes this program run in place of Webots.
const SENDER: &str = "RELAY_SENDER";
/// The environment variable with the state that it says its simulation has: the server reads the time in the streams of a
/// simulation that runs, and of no other.
const STATE: &str = "RELAY_STATE";
/// Limit of the processor time with reading compared with that without.
const READING: f64 = 1.05;

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
    let state = std::env::var(STATE).unwrap();
    actix_rt::spawn(async move {
        loop {
            println!("{state}");
            actix_rt::time::sleep(Duration::from_secs(1)).await;
        }
    });
    let listener = tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .await
        .unwrap();
    loop {
        let (mut socket, _) = listener.accept().await.unwrap();
        socket.set_nodelay(true).unwrap();
        actix_rt::spawn(async move {
            let mut begin = [0; 16];
            let Ok(length) = socket.peek(&mut begin).await else {
                return;
            };
            if begin[..length].starts_with(b"CTR") {
                // The server asks whether there is a world.
                if socket.read(&mut [0; 1024]).await.is_ok_and(|length| length > 0) {
                    socket.write_all(b"REFUSED").await.ok();
                }
                return;
            }
            let is_for = |path: &str| begin[..length].starts_with(format!("GET {path} ").as_bytes());
            if is_for("/echo") || is_for("/flood") {
                let is_echo = is_for("/echo");
                let socket = socket.into_std().unwrap();
                socket.set_nonblocking(false).unwrap();
                std::thread::spawn(move || if is_echo { echo(socket) } else { flood(socket) });
                return;
            }
            let Ok(mut client) = tokio_tungstenite::accept_async(socket).await else {
                return;
            };
            // Spreads the messages of the clients over time.
            actix_rt::time::sleep(Duration::from_micros(now() % 20_000)).await;
            let mut ticks = actix_rt::time::interval(Duration::from_secs(1) / MESSAGES);
            let mut message = vec![0; SIZE];
            loop {
                ticks.tick().await;
                let now = now();
                message[..8].copy_from_slice(&now.to_be_bytes());
                let update = format!("application/json:{{\"time\":{},", now / 1_000_000);
                message[8..8 + update.len()].copy_from_slice(update.as_bytes());
                if client.send(Message::binary(message.clone())).await.is_err() {
                    return;
                }
            }
        });
    }
}

/// Sends back each message.
fn echo(socket: TcpStream) {
    let Ok(mut client) = tungstenite::accept(socket) else {
        return;
    };
    while let Ok(message) = client.read() {
        if client.send(message).is_err() {
            return;
        }
    }
}

/// Sends messages as fast as the client takes them.
fn flood(socket: TcpStream) {
    let Ok(mut client) = tungstenite::accept(socket) else {
        return;
    };
    // A whole frame (RFC 6455, section 5.2): binary, with a length of eight bytes.
    let length = 64 << 10;
    let mut frame = vec![0x82, 127];
    frame.extend_from_slice(&u64::to_be_bytes(length));
    frame.resize(frame.len() + usize::try_from(length).unwrap(), 0);
    while client.get_mut().write_all(&frame).is_ok() {}
}

/// Measures each way in turns, and prints the medians.
pub async fn measure(verdict: &mut Verdict, time: Duration, rounds: usize) {
    println!("{STREAMS} streams of {MESSAGES} messages of {SIZE} bytes a second, {time:?} each:");
    let forge = Forge::with_arm();
    let (_webots, server, relayed) = relay(&forge, "pause").await;
    let (_reading, reader, read) = relay(&forge, "real-time").await;
    let listen = ports::block(1);
    let ports: Vec<u16> = (1..=SIMULATIONS).map(|number| server.port + number).collect();
    let locations = ports.iter().map(|port| {
        format!(
            "location /{port}/ {{ proxy_pass http://127.0.0.1:{port}/; proxy_http_version 1.1; \
             proxy_set_header Upgrade $http_upgrade; proxy_set_header Connection upgrade; proxy_buffering off; \
             proxy_read_timeout 1h; }}"
        )
    });
    let site = format!(
        "server {{ listen 127.0.0.1:{listen}; {} }}",
        locations.collect::<String>()
    );
    let nginx = WebServer::start(Kind::Nginx, (listen, listen), &site, SOON).await;
    drop(TcpStream::connect(("127.0.0.1", listen)).unwrap());
    let urls = |url: fn(u16, u16) -> String| ports.iter().map(|port| url(*port, listen)).collect::<Vec<_>>();
    let ways = [
        // The processor time of the simulation server without relayed streams.
        (
            "direct",
            urls(|port, _| format!("ws://127.0.0.1:{port}/")),
            server.pid(),
        ),
        (
            "nginx",
            urls(|port, listen| format!("ws://127.0.0.1:{listen}/{port}/")),
            nginx.pid().as_raw(),
        ),
        (
            "relay",
            relayed.iter().map(|url| format!("{url}/")).collect(),
            server.pid(),
        ),
        (
            "reading",
            read.iter().map(|url| format!("{url}/")).collect(),
            reader.pid(),
        ),
    ];
    let mut results = [const { Vec::new() }; 4];
    for _ in 0..rounds {
        for ((_, urls, process), results) in ways.iter().zip(&mut results) {
            results.push(one(urls, *process, time).await);
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
    let [direct, nginx, relay, reading] = medians[..] else {
        unreachable!()
    };
    verdict.bound("p99 beside direct", relay.0.saturating_sub(direct.0), LATER);
    verdict.ratio("processor time beside nginx", relay.1 / nginx.1, 1.0);
    verdict.ratio(
        "processor time with the time of simulations read, beside without",
        reading.1 / relay.1,
        READING,
    );

    println!(
        "{FAST} streams as fast as possible, and one that sends back {ECHO} bytes each {PERIOD:?}, {time:?} each:"
    );
    let mut results = [const { Vec::new() }; 3];
    for _ in 0..rounds {
        for ((_, urls, _), results) in ways[..3].iter().zip(&mut results) {
            let url = urls[0].clone();
            results.push(
                actix_rt::task::spawn_blocking(move || beside_fast_ones(&url, time))
                    .await
                    .unwrap(),
            );
        }
    }
    let mut medians = Vec::new();
    for ((name, _, _), results) in ways.iter().zip(&mut results) {
        let middle = results.len() / 2;
        results.sort_by_key(|one: &Beside| one.median);
        let median = results[middle].median;
        results.sort_by_key(|one| one.late);
        let late = results[middle].late;
        results.sort_by(|one, other| one.rate.total_cmp(&other.rate));
        let rate = results[middle].rate;
        println!("  {name:<8} median {median:>9.3?}, p99 {late:>9.3?}, {rate:>6.0} MiB/s");
        medians.push((late, rate));
    }
    let [_, nginx, relay] = medians[..] else { unreachable!() };
    verdict.ratio(
        "p99 beside nginx",
        relay.0.as_secs_f64() / nginx.0.as_secs_f64(),
        ECHO_BESIDE_NGINX,
    );
    verdict.ratio("throughput of nginx beside it", nginx.1 / relay.1, 1.0);
}

/// A server that relays the streams of simulations in this state, and the URLs of the streams.
async fn relay(forge: &Forge, state: &str) -> (Webots, Server, Vec<String>) {
    let program = std::env::current_exe().unwrap();
    let webots = Webots::script(&format!(
        "{SENDER}=1 {STATE}={state} exec '{}' \"$@\"",
        program.display()
    ));
    let builder = simulation_server(&webots.path(), forge.path(), SIMULATIONS)
        .set("isolation", "none")
        .set("streaming", "relay");
    let server = builder.set("hangLimit", 3600).start().await;
    let mut urls = Vec::new();
    for _ in 0..SIMULATIONS {
        let mut client = Client::start(&server, &arm()).await;
        let told = client.until("webots:").await;
        urls.push(told.replace("webots:", "").replace("localhost", "127.0.0.1"));
        actix_rt::spawn(async move { while client.next_within(Duration::MAX).await.is_some() {} });
    }
    (webots, server, urls)
}

/// What an echo takes beside fast streams, and the throughput of these, in MiB per second.
struct Beside {
    median: Duration,
    late: Duration,
    rate: f64,
}

/// Measures one way. Each connection has a thread of its own, so that they don't wait for each other here.
fn beside_fast_ones(url: &str, time: Duration) -> Beside {
    let received = Arc::new(AtomicU64::new(0));
    let is_over = Arc::new(AtomicBool::new(false));
    let readers: Vec<_> = (0..FAST)
        .map(|_| {
            let (mut socket, _) = tungstenite::connect(format!("{url}flood")).unwrap();
            let received = Arc::clone(&received);
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                let MaybeTlsStream::Plain(tcp) = socket.get_mut() else {
                    unreachable!()
                };
                let mut buffer = vec![0; 64 << 10];
                while !is_over.load(Ordering::Relaxed) {
                    let length = tcp.read(&mut buffer).unwrap();
                    assert!(length > 0, "a stream has ended");
                    received.fetch_add(u64::try_from(length).unwrap(), Ordering::Relaxed);
                }
            })
        })
        .collect();
    let (mut socket, _) = tungstenite::connect(format!("{url}echo")).unwrap();
    if let MaybeTlsStream::Plain(tcp) = socket.get_mut() {
        tcp.set_nodelay(true).unwrap();
    }
    let begin = Instant::now();
    let before = received.load(Ordering::Relaxed);
    let mut times = Vec::new();
    while begin.elapsed() < time {
        std::thread::sleep(PERIOD);
        let sent = Instant::now();
        socket.send(Message::binary(vec![0; ECHO])).unwrap();
        socket.read().unwrap();
        times.push(sent.elapsed());
    }
    let bytes = received.load(Ordering::Relaxed) - before;
    let rate = bytes as f64 / begin.elapsed().as_secs_f64() / f64::from(1 << 20);
    is_over.store(true, Ordering::Relaxed);
    readers.into_iter().for_each(|reader| reader.join().unwrap());
    times.sort();
    Beside {
        median: times[times.len() / 2],
        late: times[times.len() * 99 / 100],
        rate,
    }
}

/// Measures one way: the latency of 99 % of the messages, and the processor time of `process` and its children, in
/// percent of a core.
async fn one(urls: &[String], process: i32, time: Duration) -> Taken {
    let connecting = urls.iter().cycle().take(STREAMS).map(tokio_tungstenite::connect_async);
    let sockets: Vec<_> = join_all(connecting)
        .await
        .into_iter()
        .map(|one| one.unwrap().0)
        .collect();
    let before = processor(process);
    let begin = now();
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
