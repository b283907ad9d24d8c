//! Places and the waiting line.

use std::net::TcpListener;
use std::time::Duration;

use super::scene::{arm, nothing_left};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::simulation_server;
use crate::support::webots::Webots;
use crate::support::{http, until};

#[actix_rt::test]
async fn the_waiting_line_is_served_in_order_and_forgets_who_leaves() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 2).set("waitingLine", 4).start().await;
    let mut inside = Vec::new();
    for place in 1..=2 {
        let mut client = Client::start(&server, &arm()).await;
        assert_eq!(client.until("webots:").await, format!("webots:ws://localhost:{}", server.port + place));
        assert!(!client.heard.iter().any(|text| text.starts_with("queue")), "{:?}", client.heard);
        inside.push(client);
    }
    let mut line = Vec::new();
    for ahead in 0..4 {
        let mut client = Client::start(&server, &arm()).await;
        assert_eq!(client.until("").await, format!("queue: {ahead}"));
        client.until("loading: waiting for a place").await;
        line.push(client);
    }
    let mut late = Client::start(&server, &arm()).await;
    let told = late.until("").await;
    let words = "loading: Error: All 2 places of this simulation server are taken, and 4 clients are waiting already";
    assert!(told.starts_with(words), "{told}");
    assert_eq!(late.closed().await, Some(1000));
    // Who leaves the line is forgotten at once, and only those behind are told.
    line.remove(1).leave().await;
    assert_eq!(line[1].until("queue:").await, "queue: 1");
    assert_eq!(line[2].until("queue:").await, "queue: 2");
    assert!(line[0].is_silent(Duration::from_millis(50)).await);
    let instances = http::get(&server.url("/status")).await.json()["instances"].clone();
    assert_eq!((instances["queued"].as_u64(), instances["places"].as_u64()), (Some(3), Some(2)));
    assert_eq!(instances["arrivals"].as_u64(), Some(7));
    // The first in the line gets the place that becomes free, at its port.
    inside.remove(1).leave().await;
    assert_eq!(line[0].until("webots:").await, format!("webots:ws://localhost:{}", server.port + 2));
    assert_eq!(line[1].until("queue:").await, "queue: 0");
    assert_eq!(line[2].until("queue:").await, "queue: 1");
    for client in inside.into_iter().chain(line) {
        client.leave().await;
    }
    nothing_left(&server, 2).await;
}

#[actix_rt::test]
async fn a_port_that_somebody_else_has_is_not_lent() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    let first = TcpListener::bind(("127.0.0.1", server.port + 1)).unwrap();
    let mut client = Client::start(&server, &arm()).await;
    assert_eq!(client.until("webots:").await, format!("webots:ws://localhost:{}", server.port + 2));
    let mut second = Client::start(&server, &arm()).await;
    assert_eq!(second.until("").await, "queue: 0");
    drop(first);
    assert_eq!(second.until("webots:").await, format!("webots:ws://localhost:{}", server.port + 1));
}

#[actix_rt::test]
async fn a_crowd_is_served_to_the_last_one() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 3).start().await;
    let visits = (0..12).map(|_| async {
        let mut client = Client::start(&server, &arm()).await;
        let url = client.until("webots:").await;
        client.leave().await;
        url
    });
    let urls = futures_util::future::join_all(visits).await;
    let allowed: Vec<String> = (1..=3).map(|place| format!("webots:ws://localhost:{}", server.port + place)).collect();
    assert!(urls.iter().all(|url| allowed.contains(url)), "{urls:?}");
    nothing_left(&server, 3).await;
    until("all are counted", async || {
        http::get(&server.url("/metrics")).await.text().contains("webots_simulation_starts_total{outcome=\"ready\"} 12")
    })
    .await;
}
