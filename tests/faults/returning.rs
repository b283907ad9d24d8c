//! A session server that is started again, and all its clients come back at once.

use std::time::{Duration, Instant};

use futures_util::StreamExt;

use crate::support::client::{Client, Heard};
use crate::support::program::session_server;

/// How many clients there are.
const CLIENTS: usize = 5_000;
/// How long it may take until each of them has heard the truth again.
const BOUND: Duration = Duration::from_secs(20);

#[actix_rt::test]
async fn five_thousand_clients_come_back_at_once_and_hear_the_truth() {
    let limits = nix::sys::resource::getrlimit(nix::sys::resource::Resource::RLIMIT_NOFILE).unwrap();
    nix::sys::resource::setrlimit(nix::sys::resource::Resource::RLIMIT_NOFILE, limits.1, limits.1).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let configure = || session_server(&["127.0.0.1:1".to_owned()]).set("maxClientsPerAddress", 2 * CLIENTS);
    let mut session = configure().folder(folder.path()).start().await;
    let port = session.port;
    let url = session.websocket("/");
    let clients = come(&url).await;
    session.signal(nix::sys::signal::Signal::SIGKILL);
    session.ended().await;
    drop(clients);
    let session = configure().folder(folder.path()).port(port).start().await;
    let began = Instant::now();
    let clients = come(&url).await;
    assert!(began.elapsed() < BOUND, "it took {:?}", began.elapsed());
    let status = crate::support::http::get(&session.url("/status")).await.json();
    assert_eq!(status["clients"], clients.len());
}

/// Lets all clients connect, and waits until each has heard that no server is available.
async fn come(url: &str) -> Vec<Client> {
    let coming = futures_util::stream::iter(0..CLIENTS).map(|_| async {
        let mut client = Client::connect(url).await;
        assert!(matches!(client.next().await, Heard::Text(text) if text == "0"));
        client
    });
    // As many at a time as this one program can play.
    coming.buffer_unordered(200).collect().await
}
