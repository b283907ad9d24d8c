//! Measures how long a request for a simulation server takes.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use super::Verdict;
use super::server::Server;
use super::stand_ins::StandIns;

/// The fleets take turns, so that other load of the machine affects all of them.
const ROUNDS: usize = 40;
const REQUESTS: usize = 250;
/// Pause between two requests: a busy session server that is not saturated.
const PAUSE: Duration = Duration::from_micros(500);

/// A fleet, its session server, and how long its requests took.
struct Door {
    name: &'static str,
    path: &'static str,
    status: &'static str,
    _fleet: StandIns,
    server: Server,
    took: Vec<Duration>,
}

impl Door {
    fn open(name: &'static str, servers: usize, hung: bool) -> Self {
        let fleet = StandIns::start(servers);
        let server = Server::start(&fleet.addresses);
        if hung {
            fleet.hang_first();
        }
        Self {
            name,
            path: "/session",
            status: "200",
            _fleet: fleet,
            server,
            took: Vec::new(),
        }
    }

    /// A fleet whose servers do not accept the requested world.
    fn open_for_strangers(name: &'static str, servers: usize, repositories: usize) -> Self {
        let fleet = StandIns::with_repositories(servers, repositories);
        let server = Server::start(&fleet.addresses);
        let path = "/session?url=https://github.com/stranger/arm/blob/main/worlds/arm.wbt";
        Self {
            name,
            path,
            status: "403",
            _fleet: fleet,
            server,
            took: Vec::new(),
        }
    }

    fn ask(&mut self) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.server.port)).expect("the door is open");
        stream.set_nodelay(true).expect("a socket");
        let request = format!("GET {} HTTP/1.1\r\nHost: localhost\r\n\r\n", self.path);
        let mut answer = [0; 2048];
        for _ in 0..REQUESTS {
            let begin = Instant::now();
            stream.write_all(request.as_bytes()).expect("a request");
            let length = stream.read(&mut answer).expect("an answer");
            self.took.push(begin.elapsed());
            let answer = String::from_utf8_lossy(&answer[..length]);
            assert_eq!(answer.split(' ').nth(1), Some(self.status), "{answer}");
            std::thread::sleep(PAUSE);
        }
    }

    fn at(&self, share: f64) -> f64 {
        let mut took = self.took.clone();
        took.sort_unstable();
        1000.0 * took[((took.len() - 1) as f64 * share) as usize].as_secs_f64()
    }
}

pub(crate) fn measure(verdict: &mut Verdict) {
    println!("/session, {} requests for each fleet, in turns:", ROUNDS * REQUESTS);
    let health = |name, servers| Door {
        path: "/health",
        ..Door::open(name, servers, false)
    };
    let mut doors = [
        health("10 servers, not asked (/health)", 10),
        health("1,000 servers, not asked", 1000),
        Door::open("10 servers", 10, false),
        Door::open("10 servers, one hung", 10, true),
        Door::open("1,000 servers", 1000, false),
        Door::open_for_strangers("200 servers refuse, 200 owners", 200, 200),
    ];
    for _ in 0..ROUNDS {
        doors.iter_mut().for_each(Door::ask);
    }
    println!("  {:<32} {:>9} {:>9} {:>9}", "fleet", "p50", "p99", "p99.9");
    for door in &doors {
        println!(
            "  {:<32} {:>6.3} ms {:>6.3} ms {:>6.3} ms",
            door.name,
            door.at(0.5),
            door.at(0.99),
            door.at(0.999)
        );
    }
    let [_, _, ten, hung, thousand, refusing] = &doors;
    verdict.bound("p99 with one server hung", hung.at(0.99), 5.0, "ms");
    verdict.bound(
        "median with 1,000 servers / with 10",
        thousand.at(0.5) / ten.at(0.5),
        1.1,
        "times",
    );
    verdict.bound("median of a refusal by 200 servers", refusing.at(0.5), 3.0, "ms");
    println!(
        "  p99 with 1,000 servers / with 10: {:.2} times",
        thousand.at(0.99) / ten.at(0.99)
    );
}
