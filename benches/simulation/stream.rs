//! Measures how fast a stream is through a simulation's own network, compared with the machine's, and how much memory
//! pasta takes.
//!
//! The program that runs in place of Webots sends back what it receives, or zeros.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use procfs::process::Process;

use crate::class::{at_level, leave, ready};
use crate::support::git::Forge;
use crate::support::http;
use crate::support::program::simulation_server;
use crate::support::webots::Webots;

/// The program. Each connection has a thread.
const PROGRAM: &str = r#"for one; do case $one in --port=*) port=${one#--port=};; esac; done
exec python3 -c "
import socketserver
class Handler(socketserver.StreamRequestHandler):
    disable_nagle_algorithm = True
    def handle(self):
        path = self.rfile.readline().split()[1]
        while self.rfile.readline().strip(): pass
        self.wfile.write(b'HTTP/1.0 200 OK\r\n\r\n')
        while path == b'/zeros': self.wfile.write(bytes(65536))
        while path == b'/echo': self.wfile.write(self.rfile.read(SIZE))
socketserver.ThreadingTCPServer.allow_reuse_address = True
socketserver.ThreadingTCPServer(('127.0.0.1', $port), Handler).serve_forever()"
"#;
/// The size of a message that is sent back, in bytes, and the interval between two of them.
const MESSAGE: usize = 300;
const PERIOD: Duration = Duration::from_millis(20);

/// Prints the latency of these numbers of streams at once, and the throughput of one stream.
pub async fn measure(sizes: &[u16], time: Duration) {
    let sizes = if sizes.is_empty() { &[1, 100] } else { sizes };
    println!("streams of 50 messages a second, {MESSAGE} bytes there and back:");
    let forge = Forge::with_arm();
    let webots = Webots::script(&PROGRAM.replace("SIZE", &MESSAGE.to_string()));
    for &size in sizes {
        for level in ["sandbox", "own"] {
            let builder = simulation_server(&webots.path(), forge.path(), 200).set("timing.launch", 60);
            let server = at_level(builder.set("hangLimit", 3600), level).start().await;
            let clients = ready(&server, size).await;
            let status = http::get(&server.url("/status")).await.json();
            let all = status["simulations"].as_array().unwrap();
            let ports: Vec<u16> = all
                .iter()
                .map(|one| one["port"].as_u64().unwrap().try_into().unwrap())
                .collect();
            let root = Process::new(all[0]["pid"].as_i64().unwrap().try_into().unwrap()).unwrap();
            let resident = (root.stat().unwrap().rss * procfs::page_size()) >> 10;
            let first = ports[0];
            let (mut times, rate) = actix_rt::task::spawn_blocking(move || {
                let threads: Vec<_> = ports
                    .into_iter()
                    .map(|port| std::thread::spawn(move || echo(port, time)))
                    .collect();
                let times: Vec<Duration> = threads.into_iter().flat_map(|one| one.join().unwrap()).collect();
                (times, zeros(first, time))
            })
            .await
            .unwrap();
            times.sort();
            let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
            println!(
                "  {level:<8}{size:>5}: median {:>9.3?}  p99 {:>9.3?}  worst {:>9.3?}; one carries {rate:.0} MiB/s; resident in {} {resident} KiB",
                at(0.5),
                at(0.99),
                at(1.0),
                root.stat().unwrap().comm,
            );
            leave(&server, clients).await;
        }
    }
}

fn open(port: u16, path: &str) -> TcpStream {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream
        .write_all(format!("GET {path} HTTP/1.0\r\n\r\n").as_bytes())
        .unwrap();
    let mut head = [0; 19];
    stream.read_exact(&mut head).unwrap();
    stream
}

fn echo(port: u16, time: Duration) -> Vec<Duration> {
    let mut stream = open(port, "/echo");
    let begin = Instant::now();
    let mut times = Vec::new();
    let mut message = [7; MESSAGE];
    while begin.elapsed() < time {
        let sent = Instant::now();
        stream.write_all(&message).unwrap();
        stream.read_exact(&mut message).unwrap();
        times.push(sent.elapsed());
        std::thread::sleep(PERIOD.saturating_sub(sent.elapsed()));
    }
    times
}

fn zeros(port: u16, time: Duration) -> f64 {
    let mut stream = open(port, "/zeros");
    let begin = Instant::now();
    let mut sum = 0;
    let mut chunk = vec![0; 1 << 20];
    while begin.elapsed() < time {
        sum += stream.read(&mut chunk).unwrap();
    }
    sum as f64 / begin.elapsed().as_secs_f64() / f64::from(1 << 20)
}
