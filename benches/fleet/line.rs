//! Measures what a long line costs: memory for each client, and processor time for the positions that change.

use std::io::Write;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use super::Verdict;
use super::idle::memory;
use super::push::connect;
use super::server::Server;
use super::support::reserving::ReservingServer;

const CLIENTS: usize = 5000;
/// Clients that have waited and gone before: part of the memory is allocated once for the server.
const FIRST: usize = 1000;
/// Time of each measurement.
const TIME: Duration = Duration::from_secs(20);
/// Pause between two slots that become free: as with a hundred slots, each for ten seconds.
const BETWEEN_TURNS: Duration = Duration::from_millis(100);

/// Sends a text as a client, with a mask that changes nothing.
fn say(stream: &mut TcpStream, text: &str) {
    let length = u8::try_from(text.len()).expect("a short text");
    assert!(length < 126, "a short text");
    let frame = [&[0x81, 0x80 | length, 0, 0, 0, 0], text.as_bytes()].concat();
    stream.write_all(&frame).expect("a client sends");
}

fn waiting(server: &Server) -> usize {
    let page = server.page("/metrics").expect("the metrics");
    let line = page
        .lines()
        .find_map(|line| line.strip_prefix("webots_session_waiting "));
    line.and_then(|count| count.trim().parse().ok()).expect("a number")
}

fn enter(clients: &mut [TcpStream]) {
    for client in clients {
        say(
            client,
            r#"{"url": "https://github.com/lab/arm/blob/main/worlds/a.wbt", "wait": true}"#,
        );
    }
}

/// Percent of a core that the server needs.
async fn needs(server: &Server) -> f64 {
    let begin = Instant::now();
    let (_, before) = server.processor_time();
    actix_rt::time::sleep(TIME).await;
    let (_, after) = server.processor_time();
    100.0 * after.saturating_sub(before).as_secs_f64() / begin.elapsed().as_secs_f64()
}

/// Gives a slot to the first of the line again and again; returns the number of turns.
async fn serve(simulation: &mut ReservingServer) -> usize {
    let mut link = simulation.link().await;
    let mut turns = 0;
    let mut known = Vec::new();
    let mut number = 0;
    let mut next = actix_rt::time::interval(BETWEEN_TURNS);
    loop {
        tokio::select! {
            wishes = link.wishes_if_any() => {
                let Some(wishes) = wishes else { return turns };
                known = wishes.first.iter().map(|wish| wish.ticket).rev().collect();
                number = wishes.number;
                link.reserve(number, []).await;
            }
            _ = next.tick() => if let Some(first) = known.pop() {
                turns += 1;
                link.reserve(number, [first]).await;
            },
        }
    }
}

pub(crate) fn measure(verdict: &mut Verdict) {
    actix_rt::System::new().block_on(measured(verdict));
}

async fn measured(verdict: &mut Verdict) {
    println!("{CLIENTS} clients in the line:");
    let mut simulation = ReservingServer::start(1, 10.0).await;
    let keys = serde_json::json!({"fleetKey": "a secret of this bench", 
        "timing": {"ping": 600, "silence": 3600}});
    let addresses = [simulation.address.clone()];
    let server = actix_rt::task::spawn_blocking(move || Server::start_with(&addresses, &keys));
    let server = server.await.expect("the session server");
    // Both ends of the connections are in this program.
    let port = server.port;
    let come = move |count| -> Vec<TcpStream> { (0..count).map(|_| connect(port)).collect() };
    let come = async move |count| {
        let connected = actix_rt::task::spawn_blocking(move || come(count)).await;
        connected.expect("clients")
    };
    let mut first = come(FIRST).await;
    let mut clients = come(CLIENTS).await;
    simulation.report(1, 1);
    let settled = async |count| {
        let begin = Instant::now();
        while waiting(&server) != count {
            assert!(begin.elapsed() < Duration::from_mins(1), "{} wait", waiting(&server));
            actix_rt::time::sleep(Duration::from_millis(100)).await;
        }
        actix_rt::time::sleep(Duration::from_secs(2)).await;
    };
    actix_rt::time::sleep(Duration::from_secs(3)).await;
    enter(&mut first);
    settled(FIRST).await;
    drop(first);
    settled(0).await;
    let before = memory(server.process());
    let connected = needs(&server).await;
    enter(&mut clients);
    settled(CLIENTS).await;
    let each = (memory(server.process()) - before) / CLIENTS as f64;
    let still = needs(&server).await;
    let serving = actix_rt::spawn(async move { serve(&mut simulation).await });
    let left = waiting(&server);
    let moving = needs(&server).await;
    let turns = left - waiting(&server);
    serving.abort();
    println!("  connected, and not in the line: {connected:.1} % of a core");
    println!("  in the line, while it stands still: {still:.1} % of a core");
    println!(
        "  while {turns} turns come in {} s: {moving:.1} % of a core",
        TIME.as_secs()
    );
    assert!(turns > 100, "only {turns} turns");
    verdict.bound("memory of a ticket", each, 1.0, "KiB");
    verdict.bound("positions that change", moving - still, 2.0, "% of a core");
}
