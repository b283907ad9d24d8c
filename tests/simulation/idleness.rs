//! A simulation that stays paused ends, unless its client keeps it; the client is warned. One that runs does not end.

use std::time::{Duration, Instant};

use serde_json::json;

use super::life::quick;
use super::scene::nothing_left;
use crate::support::{Client, arm, demo_server};

/// In minutes: three seconds. The client is warned when half of it is left.
const LIMIT: f64 = 0.05;
const TOLD: &str = "idle: 2";
const WHY: &str = "The simulation was paused for 0.05 min";

#[actix_rt::test]
async fn a_paused_simulation_ends_unless_its_client_keeps_it() {
    let builder = quick(demo_server(1)).set("idleTimeout", LIMIT);
    let server = builder.set("streaming", "relay").start().await;
    // An old page that sends nothing more.
    let begin = Instant::now();
    let mut client = Client::start(&server, &arm()).await;
    let address = client.until("webots:").await;
    let stream = Client::connect(address.strip_prefix("webots:").unwrap()).await;
    let mut viewer = stream.with_scene().await;
    assert_eq!(client.until("idle:").await, TOLD);
    let told = client.until("loading: Error:").await;
    assert!(told.starts_with(&format!("loading: Error: {WHY}")), "{told}");
    assert_eq!(client.closed().await, Some(1000));
    assert_eq!(viewer.closed_with().await, Some((1000, WHY.to_owned())));
    assert!(begin.elapsed() >= Duration::from_secs(3), "{:?}", begin.elapsed());
    nothing_left(&server, 1).await;
    let metrics = server.metrics().await;
    assert!(
        metrics.contains("webots_simulation_ends_total{reason=\"idle\"} 1"),
        "{metrics}"
    );

    let (mut client, _) = Client::resumable(&server).await;
    for _ in 0..2 {
        assert_eq!(client.until("idle:").await, TOLD);
        client.send(&json!({"keep": true}).to_string()).await;
        assert_eq!(client.until("idle:").await, "idle: never");
    }
    client.until(&format!("loading: Error: {WHY}")).await;
    nothing_left(&server, 1).await;
}

#[actix_rt::test]
async fn who_runs_is_never_ended_for_it() {
    let server = quick(demo_server(1)).set("idleTimeout", LIMIT).start().await;
    let (mut client, _) = Client::resumable(&server).await;
    let mut viewer = Client::connect(&format!("ws://127.0.0.1:{}/", server.port + 1))
        .await
        .with_running_scene()
        .await;
    // Twice as long as a simulation may be paused.
    while viewer.time().await < 6000.0 {}
    client.until(".").await;
    assert!(
        !client.heard.iter().any(|text| text.starts_with("idle: 2")),
        "{:?}",
        client.heard
    );
    viewer.send("pause").await;
    assert_eq!(client.until("idle:").await, TOLD);
    viewer.send("real-time:-1").await;
    assert_eq!(client.until("idle:").await, "idle: never");
    let now = viewer.time().await;
    while viewer.time().await < now + 3000.0 {}
    assert_eq!(server.simulations().await.len(), 1);
}
