//! A session server restarts, and all its clients return at once.

use std::time::{Duration, Instant};

use futures_util::StreamExt;

use crate::support::ports::dead_port;
use crate::support::{Client, demo_server, session_server};

const CLIENTS: usize = 5_000;
/// Longest time until all of them have received the availability again.
const BOUND: Duration = Duration::from_secs(20);

#[actix_rt::test]
async fn on_a_quiet_machine_five_thousand_clients_reconnect_at_once() {
    crate::support::raise_file_limit();
    let folder = tempfile::tempdir().unwrap();
    let (reserved, simulation_port) = dead_port();
    let servers = [format!("127.0.0.1:{simulation_port}")];
    // Load on this machine must not make its simulation server full.
    let configure = || {
        session_server(&servers)
            .set("maxClientsPerAddress", 2 * CLIENTS)
            .set("loadThreshold", 1_000)
    };
    let mut session = configure().folder(folder.path()).start().await;
    let port = session.port;
    let url = session.websocket("/");
    let clients = come(&url, "0").await;
    session.signal(nix::sys::signal::Signal::SIGKILL);
    session.ended().await;
    drop((clients, reserved));
    let _simulation = demo_server(1).port(simulation_port).start().await;
    let session = configure().folder(folder.path()).port(port).start().await;
    let began = Instant::now();
    let clients = come(&url, "1").await;
    assert!(began.elapsed() < BOUND, "it took {:?}", began.elapsed());
    let status = session.status().await;
    assert_eq!(status["clients"], clients.len());
}

/// Connects all clients, and waits until each has received this availability.
async fn come(url: &str, truth: &str) -> Vec<Client> {
    let coming = futures_util::stream::iter(0..CLIENTS).map(|_| async {
        let mut client = Client::connect(url).await;
        client.until(truth).await;
        client
    });
    // As many at a time as this test can handle.
    coming.buffer_unordered(200).collect().await
}
