//! Measures the memory of a WebSocket client that only waits for messages.

use std::net::TcpStream;
use std::time::Duration;

use super::bare::Bare;
use super::goal;
use super::push::connect;
use super::server::Server;
use super::stand_ins::StandIns;

/// Clients before the measurement: part of their memory is allocated once for the server.
const FIRST: usize = 1000;
const CLIENTS: usize = 8000;

/// The anonymous memory of a process, in KiB.
pub(crate) fn memory(process: u32) -> f64 {
    let process = procfs::process::Process::new(i32::try_from(process).expect("a process id"));
    let status = process.and_then(|process| process.status()).expect("the server runs");
    status.rssanon.expect("Linux 4.5 or newer") as f64
}

/// The memory per client, in KiB.
fn each(process: u32, port: u16) -> f64 {
    let come = |count| -> Vec<TcpStream> { (0..count).map(|_| connect(port)).collect() };
    let _first = come(FIRST);
    std::thread::sleep(Duration::from_secs(1));
    let before = memory(process);
    let _clients = come(CLIENTS);
    std::thread::sleep(Duration::from_secs(1));
    (memory(process) - before) / CLIENTS as f64
}

pub(crate) fn measure() {
    println!("memory of an idle WebSocket client, of {CLIENTS}:");
    let bare = Bare::start();
    println!(
        "  one actor of actix for each, and nothing else: {:.1} KiB",
        each(bare.process(), bare.port)
    );
    let fleet = StandIns::start(1);
    let server = Server::start(&fleet.addresses);
    let found = each(server.process(), server.port);
    goal(
        "a client of the session server",
        found <= 11.0,
        &format!("{found:.1} KiB, aimed at 11"),
    );
}
