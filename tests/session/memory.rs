//! The memory that clients cost if they read nothing.

use std::io::{ErrorKind, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use socket2::{Domain, Socket, Type};

use super::until_states;
use crate::support::program::{Server, session_server};
use crate::support::{http, until};

const CLIENTS: usize = 25;
/// The longest time that they send.
const LONGEST: Duration = Duration::from_secs(5);
/// The memory that each of them may cost, in bytes.
const LIMIT: u64 = 512 << 10;

/// The memory of a server, in bytes.
fn memory(server: &Server) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.pid())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}

/// A client with a small receive buffer.
fn connect(server: &Server) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.set_recv_buffer_size(4096).unwrap();
    let address: std::net::SocketAddr = server.address().parse().unwrap();
    socket.connect(&address.into()).unwrap();
    socket.set_nonblocking(true).unwrap();
    socket.into()
}

/// Sends these requests repeatedly, as many as the server accepts from each client.
async fn fill(clients: &mut [TcpStream], requests: &[u8]) {
    // A server may keep accepting bytes that it ignores.
    let deadline = Instant::now() + LONGEST;
    let mut progress = Instant::now();
    let mut sent = vec![0; clients.len()];
    while progress.elapsed() < Duration::from_secs(1) && Instant::now() < deadline {
        for (client, sent) in clients.iter_mut().zip(&mut sent) {
            match client.write(&requests[*sent..]) {
                Ok(count) => {
                    *sent = (*sent + count) % requests.len();
                    progress = Instant::now();
                }
                Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock, "{error}"),
            }
        }
        actix_rt::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Asserts that `CLIENTS` clients that send these requests and read nothing cost little memory.
async fn cost_little(server: &Server, requests: &str) {
    let before = memory(server);
    let mut clients: Vec<TcpStream> = (0..CLIENTS).map(|_| connect(server)).collect();
    fill(&mut clients, requests.as_bytes()).await;
    let cost = memory(server).saturating_sub(before);
    assert_eq!(http::get(&server.url("/health")).await.status, 200);
    let most = u64::try_from(CLIENTS).unwrap() * LIMIT;
    assert!(cost < most, "{requests:.20}: {cost} bytes for {CLIENTS} clients");
}

#[actix_rt::test]
async fn clients_that_ask_much_and_read_nothing_cost_little() {
    // Large answers, and answers that are little more than a head.
    let ask = async |request: &str| {
        let session = session_server(&["127.0.0.1:1".to_owned()]).start().await;
        until_states(&session, &["down"]).await;
        let requests = format!("{request} HTTP/1.1\r\nHost: x\r\n\r\n").repeat(1000);
        cost_little(&session, &requests).await;
    };
    futures_util::join!(ask("GET /monitor"), ask("OPTIONS /load"));
}

#[actix_rt::test]
async fn live_pages_that_read_nothing_cost_little() {
    let fleet: Vec<String> = (1..=1000).map(|port| format!("127.0.0.1:{port}")).collect();
    let session = session_server(&fleet).set("loadRefresh", 600).start().await;
    until_states(&session, &vec!["down"; fleet.len()]).await;
    // The page is rendered for the first client.
    let request = "GET /events HTTP/1.1\r\nHost: x\r\n\r\n";
    let mut first = connect(&session);
    first.write_all(request.as_bytes()).unwrap();
    until("the page comes", async || first.peek(&mut [0]).is_ok()).await;
    cost_little(&session, request).await;
}
