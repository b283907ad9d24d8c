//! Measures how long a change takes to reach 10,000 connected clients.
//!
//! The time begins with the registry's log line, which is written before the first message is sent. The kernel
//! timestamps each message at the client's socket, so that the clients need no processor time meanwhile.

use std::io::{IoSliceMut, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::time::{Duration, SystemTime};

use nix::sys::socket::{ControlMessageOwned, MsgFlags, recvmsg, setsockopt, sockopt};

use super::Verdict;
use super::server::Server;
use super::stand_ins::StandIns;

const CLIENTS: usize = 10_000;
const CHANGES: usize = 10;
/// Time for which the clients leave the processor to the server.
const PAUSE: Duration = Duration::from_millis(600);
const HANDSHAKE: &[u8] = b"GET /session HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
    Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
/// The header of an unmasked text message of one letter.
const TEXT: [u8; 2] = [0x81, 1];

/// Connects a client, and waits until it has received the first value.
pub(crate) fn connect(port: u16) -> TcpStream {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a client connects");
    stream.write_all(HANDSHAKE).expect("a client asks");
    let mut heard = Vec::new();
    let mut piece = [0; 512];
    while !tells(&heard, b'1') {
        let length = stream.read(&mut piece).expect("a client hears");
        assert!(length > 0, "a client was sent away");
        heard.extend_from_slice(&piece[..length]);
    }
    setsockopt(&stream, sockopt::ReceiveTimestampns, &true).expect("the system notes times");
    stream
}

fn tells(heard: &[u8], value: u8) -> bool {
    heard.windows(3).any(|text| text == [TEXT[0], TEXT[1], value])
}

/// When a client's message arrived, as the time since 1970.
fn arrival(stream: &TcpStream, value: u8) -> Duration {
    loop {
        let mut heard = [0; 64];
        let mut parts = [IoSliceMut::new(&mut heard)];
        let mut control = nix::cmsg_space!(nix::sys::time::TimeSpec);
        let message = recvmsg::<()>(stream.as_raw_fd(), &mut parts, Some(&mut control), MsgFlags::empty());
        let message = message.expect("a client hears");
        let length = message.bytes;
        assert!(length > 0, "a client was sent away");
        let at = message.cmsgs().expect("whole notes").find_map(|note| match note {
            ControlMessageOwned::ScmTimestampns(at) => Some(Duration::from(at)),
            _ => None,
        });
        // Anything else is a ping.
        if tells(&heard[..length], value) {
            return at.expect("the system has noted when");
        }
    }
}

/// When the registry logged the last change, to the millisecond, as the time since 1970.
fn decision(server: &Server) -> Duration {
    let log = server.log();
    let line = log
        .lines()
        .rfind(|line| line.contains("simulation server is available"))
        .expect("a decision");
    let at = line.split(' ').next().expect("a line begins with its time");
    let at = humantime::parse_rfc3339(at).expect("a time");
    at.duration_since(SystemTime::UNIX_EPOCH)
        .expect("it is later than 1970")
}

/// The reference without a server: the milliseconds until as many plain sends arrive, on all cores. Only half of them
/// are sent, and the time is doubled, because this program has both ends of each connection open.
fn yardstick() -> f64 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = listener.local_addr().expect("it is bound").port();
    let pair = |_| {
        let client = TcpStream::connect(("127.0.0.1", port)).expect("a client connects");
        setsockopt(&client, sockopt::ReceiveTimestampns, &true).expect("the system notes times");
        let (server, _) = listener.accept().expect("a client comes");
        server.set_nodelay(true).expect("a socket");
        (client, server)
    };
    let (clients, mut servers): (Vec<_>, Vec<_>) = (0..CLIENTS / 2).map(pair).unzip();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let begin = SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .expect("it is later than 1970");
    std::thread::scope(|scope| {
        for part in servers.chunks_mut((CLIENTS / 2).div_ceil(cores)) {
            scope.spawn(|| {
                for one in part.iter_mut() {
                    one.write_all(&[TEXT[0], TEXT[1], b'1']).expect("sent");
                }
            });
        }
    });
    let last = clients
        .iter()
        .map(|client| arrival(client, b'1'))
        .max()
        .expect("there are clients");
    2.0 * 1000.0 * last.saturating_sub(begin).as_secs_f64()
}

pub(crate) fn measure(verdict: &mut Verdict) {
    let mut bare: Vec<f64> = (0..5).map(|_| yardstick()).collect();
    bare.sort_unstable_by(f64::total_cmp);
    let bare = bare[2];
    println!("{CLIENTS} bare sends on all cores, without a server: {bare:.1} ms");
    let fleet = StandIns::start(1);
    let server = Server::start(&fleet.addresses);
    println!("telling {CLIENTS} clients, {CHANGES} changes:");
    let clients: Vec<TcpStream> = (0..CLIENTS).map(|_| connect(server.port)).collect();
    let mut worst = Vec::new();
    let before = server.processor_time();
    for change in 0..CHANGES {
        // The only simulation server has a load of 5 %.
        let (threshold, value) = if change % 2 == 0 { (4, b'0') } else { (95, b'1') };
        let decisions = server.log().matches("simulation server is available").count();
        server.reread(threshold);
        server.wait_until(|server| server.log().matches("simulation server is available").count() > decisions);
        std::thread::sleep(PAUSE);
        let arrivals: Vec<Duration> = clients.iter().map(|client| arrival(client, value)).collect();
        let decided = decision(&server);
        let mut after: Vec<f64> = arrivals
            .iter()
            .map(|at| 1000.0 * at.saturating_sub(decided).as_secs_f64())
            .collect();
        after.sort_unstable_by(f64::total_cmp);
        let [first, half, last] = [after[0], after[CLIENTS / 2], after[CLIENTS - 1]];
        println!(
            "  told {}: first {first:.1} ms, half {half:.1} ms, last {last:.1} ms after the decision",
            char::from(value)
        );
        worst.push(last);
    }
    let after = server.processor_time();
    let each = |after: Duration, before: Duration| 1000.0 * after.saturating_sub(before).as_secs_f64() / CHANGES as f64;
    let user = each(after.0, before.0);
    let all = each(after.1, before.1);
    println!("  processor time of each change, on all cores together: {all:.0} ms, {user:.0} ms of it in user code");
    worst.sort_unstable_by(f64::total_cmp);
    let median = worst[CHANGES / 2];
    verdict.bound(
        "the last client, median of the changes, beside the bare sends",
        median / bare,
        2.0,
        "times",
    );
    println!(
        "  the last client: median {median:.1} ms, worst {:.1} ms",
        worst[CHANGES - 1]
    );
}
