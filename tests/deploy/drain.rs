//! An upgrade that costs nobody a simulation: the server takes no new clients, and ends when the last has gone.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use crate::support::client::Client;
use crate::support::program::{demo_server, session_server};
use crate::support::{SOON, http, until};

async fn ask(request: awc::ClientRequest, password: Option<&str>) -> u16 {
    let request = match password {
        Some(password) => request.basic_auth("admin", password),
        None => request,
    };
    request.send().await.unwrap().status().as_u16()
}

#[actix_rt::test]
async fn a_draining_server_is_offered_for_less_than_a_second_more() {
    let server = demo_server(40).start().await;
    // As the fleets of deploy/swarm and deploy/kubernetes have it.
    let config = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/swarm/session.json")).unwrap();
    let config: serde_json::Value = serde_json::from_slice(&config).unwrap();
    let session = session_server(&[server.address()]).set("loadRefresh", config["loadRefresh"].clone());
    // Neither other tests on this machine nor those who ask here close the server.
    let session = session.set("loadThreshold", 1000).set("clientCost", 0.001).start().await;
    let offered = async || http::get(&session.url("/session")).await.text().starts_with("ws://");
    until("it is offered", offered).await;
    let _client = Client::ready(&server).await;
    assert!(offered().await);

    server.signal(Signal::SIGUSR1);
    let drains = Instant::now();
    // Who asks here is held up as well where the machine does other things for a while.
    let (mut asked, mut held_up) = (drains, Duration::ZERO);
    while offered().await {
        let last = asked;
        assert!(last.elapsed() < SOON, "it is offered for ever");
        assert!(last - drains < Duration::from_secs(1) + held_up, "offered to one who asked {:?} later", last - drains);
        actix_rt::time::sleep(Duration::from_millis(50)).await;
        asked = Instant::now();
        held_up = held_up.max(asked - last - Duration::from_millis(50));
    }
}

#[actix_rt::test]
async fn passwords_can_not_be_guessed_at_without_end() {
    let mut server = demo_server(1).set("adminPassword", "open sesame").start().await;
    let clients = awc::Client::builder().timeout(SOON).finish();
    let at = |request: awc::ClientRequest, address| request.insert_header(("x-forwarded-for", address));
    let output = async |address, password| ask(at(clients.get(server.url("/output?id=1")), address), password).await;
    let drain = async |address, password| ask(at(clients.post(server.url("/drain")), address), password).await;
    let mut answers = Vec::new();
    for _ in 0..20 {
        answers.push(output("203.0.113.9", Some("guess")).await);
        answers.push(drain("203.0.113.9", Some("guess")).await);
    }
    assert!(answers.starts_with(&[401; 30]) && answers.ends_with(&[429; 5]), "{answers:?}");
    assert_eq!(drain("203.0.113.9", Some("open sesame")).await, 429, "it must not learn which one is right");
    assert_eq!(drain("203.0.113.9", None).await, 401, "nothing was tried");
    assert!(server.log().contains("client 203.0.113.9: a wrong administrator password"));
    assert_eq!(output("203.0.113.10", Some("open sesame")).await, 404, "others are let in");
    assert_eq!(drain("203.0.113.10", Some("open sesame")).await, 202);
    assert_eq!(server.ended().await, Some(0));
}
