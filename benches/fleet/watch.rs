//! Measures the processor time that the session server needs to probe a fleet.

use std::time::{Duration, Instant};

use super::Verdict;
use super::server::Server;
use super::stand_ins::StandIns;

const TIME: Duration = Duration::from_secs(15);

/// Percent of one core: in user code, and in all.
fn needs(servers: usize) -> (f64, f64) {
    let fleet = StandIns::start(servers);
    let server = Server::start(&fleet.addresses);
    // The first probes open connections.
    std::thread::sleep(Duration::from_secs(3));
    let begin = Instant::now();
    let before = server.processor_time();
    std::thread::sleep(TIME);
    let elapsed = begin.elapsed();
    let after = server.processor_time();
    let percent = |used: Duration| 100.0 * used.as_secs_f64() / elapsed.as_secs_f64();
    (
        percent(after.0.saturating_sub(before.0)),
        percent(after.1.saturating_sub(before.1)),
    )
}

/// The same number of exchanges per second without a server: one thread that requests them by plain blocking calls.
fn yardstick(servers: usize) -> f64 {
    use std::io::{Read, Write};
    let fleet = StandIns::start(servers);
    let connect = |address: &String| {
        let stream = std::net::TcpStream::connect(address).expect("a stand-in");
        stream.set_nodelay(true).expect("a socket");
        stream
    };
    let mut streams: Vec<_> = fleet.addresses.iter().map(connect).collect();
    let used = || {
        let stat = procfs::process::Process::myself().and_then(|process| process.task_main_thread()?.stat());
        let stat = stat.expect("this thread runs");
        (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
    };
    let mut answer = [0; 2048];
    let before = used();
    let mut exchanges = 0.0;
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(3) {
        for stream in &mut streams {
            stream
                .write_all(b"GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n")
                .expect("a request");
            assert!(stream.read(&mut answer).expect("an answer") > 0, "a stand-in is gone");
            exchanges += 1.0;
        }
    }
    100.0 * (used() - before) / exchanges * servers as f64
}

pub(crate) fn measure(verdict: &mut Verdict) {
    println!("processor time to watch a fleet, one look a second:");
    let bare = yardstick(1000);
    println!("  1,000 bare exchanges a second (blocking calls, nothing understood): {bare:.1} % of a core");
    let (user, ten) = needs(10);
    println!("     10 servers: {ten:.1} % of a core, {user:.1} % in user code");
    let (user, thousand) = needs(1000);
    println!(
        "  1,000 servers: {thousand:.1} % of a core, {user:.1} % in user code; {:.1} times the bare exchanges",
        thousand / bare
    );
    verdict.bound("watching 1,000 servers", thousand, 10.0, "% of a core");
}
