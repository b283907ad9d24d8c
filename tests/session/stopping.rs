//! SIGTERM and SIGHUP.

use std::time::{Duration, Instant};

use futures_util::future::join_all;
use nix::sys::signal::Signal;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::stand_in::{Manner, StandIn};
use super::{addresses, times_logged, until_states};
use crate::support::client::Client;
use crate::support::program::session_server;
use crate::support::stopwatch::Stopwatch;
use crate::support::{http, until};

#[actix_rt::test]
async fn a_stop_notifies_clients_and_takes_five_seconds_at_most() {
    let servers = [StandIn::start(Manner::idle(1.0, 10)), StandIn::start(Manner::Hang)];
    let mut session = session_server(&addresses(&servers)).start().await;
    let url = session.websocket("/session");
    let mut clients = join_all((0..1000).map(|_| Client::connect(&url))).await;
    join_all(clients.iter_mut().map(|client| client.until("1"))).await;
    // Connections that never end by themselves: one that sends nothing, one that sends half a request.
    let silent = tokio::net::TcpStream::connect(session.address()).await.unwrap();
    let half = tokio::net::TcpStream::connect(session.address()).await.unwrap();
    half.try_write(b"GET /session HTTP/1.1\r\nHost:").unwrap();
    let stopwatch = Stopwatch::start();
    let lap = stopwatch.lap();
    session.signal(Signal::SIGTERM);
    let codes = join_all(clients.iter_mut().map(Client::closed)).await;
    assert_eq!(codes, vec![Some(1001); 1000]);
    drop(clients);
    // It still waits for the others, and accepts no new connection.
    until("nobody answers", async || {
        tokio::net::TcpStream::connect(session.address()).await.is_err()
    })
    .await;
    assert_eq!(session.ended().await, Some(0));
    assert!(
        lap.elapsed() < Duration::from_secs(5),
        "the end took {:?} of {:?}",
        lap.elapsed(),
        lap.wall()
    );
    drop((silent, half));
    assert_eq!(
        (
            times_logged(&session, ": stopping"),
            times_logged(&session, ": stopped")
        ),
        (1, 1)
    );
}

#[actix_rt::test]
async fn connections_that_wait_for_another_request_end_at_once() {
    let mut session = session_server(&[]).start().await;
    let mut idle = tokio::net::TcpStream::connect(session.address()).await.unwrap();
    idle.write_all(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
        .await
        .unwrap();
    assert!(idle.read(&mut [0; 1000]).await.unwrap() > 0);
    let begin = Instant::now();
    session.signal(Signal::SIGTERM);
    idle.read_to_end(&mut Vec::new()).await.unwrap();
    assert_eq!(session.ended().await, Some(0));
    assert!(
        begin.elapsed() < Duration::from_secs(2),
        "the end took {:?} of 4 s",
        begin.elapsed()
    );
}

#[actix_rt::test]
async fn servers_are_added_and_removed_without_dropping_a_client() {
    let servers = [1.0, 2.0, 3.0].map(|load| StandIn::start(Manner::idle(load, 100)));
    let [one, two, three] = servers.each_ref().map(StandIn::address);
    let session = session_server(std::slice::from_ref(&one))
        .set("loadRefresh", 600)
        .set("clientCost", 0.001)
        .start()
        .await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    client.until("1").await;
    let place = async || http::get(&session.url("/session")).await.text();
    assert_eq!(place().await, servers[0].url());
    session.reload(json!({"simulationServers": [one, two, three]}));
    until_states(&session, &["up"; 3]).await;
    session.reload(json!({"drainedServers": [one]}));
    until_states(&session, &["draining", "up", "up"]).await;
    assert_eq!(place().await, servers[1].url());
    session.reload(json!({"simulationServers": [one, three]}));
    until_states(&session, &["draining", "up"]).await;
    assert_eq!(place().await, servers[2].url());
    session.reload(json!({"drainedServers": []}));
    until_states(&session, &["up", "up"]).await;
    assert_eq!(place().await, servers[0].url());
    assert_eq!(
        client.heard,
        ["0", "1"].map(str::to_owned)[usize::from(client.heard[0] == "1")..]
    );
    // All servers drained counts as no server available.
    session.reload(json!({"drainedServers": [one, three]}));
    assert_eq!(client.until("0").await, "0");
    session.reload(json!({"drainedServers": []}));
    client.until("1").await;
    // A reloaded threshold takes effect at once, too.
    session.reload(json!({"loadThreshold": 0.5}));
    client.until("0").await;
    let asked = servers[1].requests();
    session.reload(json!({"loadThreshold": 90, "loadRefresh": 0.05}));
    client.until("1").await;
    until("the others are asked", async || {
        servers[0].requests() > 5 && servers[2].requests() > 5
    })
    .await;
    assert_eq!(servers[1].requests(), asked, "a removed server is left alone");
}

#[actix_rt::test]
async fn a_configuration_that_can_not_be_used_changes_nothing() {
    let servers = [StandIn::start(Manner::idle(50.0, 10))];
    let session = session_server(&addresses(&servers))
        .set("clientCost", 0.001)
        .start()
        .await;
    until_states(&session, &["up"]).await;
    // Valid keys beside an invalid one are not applied either.
    session.reload(json!({"loadThreshold": 40, "simulationServers": "none"}));
    until("it says so", async || {
        session.log().contains("the configuration stays as it was")
    })
    .await;
    let asked = servers[0].requests();
    until("it is judged anew", async || servers[0].requests() >= asked + 3).await;
    until_states(&session, &["up"]).await;
    assert_eq!(http::get(&session.url("/session")).await.text(), servers[0].url());
    // Nor does the server block on a named pipe in place of the file.
    let file = session.folder.join("config.json");
    std::fs::remove_file(&file).unwrap();
    nix::unistd::mkfifo(&file, nix::sys::stat::Mode::S_IRWXU).unwrap();
    session.signal(Signal::SIGHUP);
    until("it says so", async || {
        session.log().contains("it is not a regular file")
    })
    .await;
    assert_eq!(http::get(&session.url("/session")).await.text(), servers[0].url());
}
