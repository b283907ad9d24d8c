//! A simulation whose stream nobody opens ends, so that a page that was left keeps no slot.

use std::time::{Duration, Instant};

use futures_util::future::join_all;

use super::life::quick;
use super::relay::{look_on, watched_by};
use super::scene::nothing_left;
use crate::isolation::deeds::Stage;
use crate::isolation::network::levels;
use crate::support::client::Heard;
use crate::support::http::PASSWORD;
use crate::support::{Builder, Client, SOON, Webots, arm, demo_server};

/// Seconds in which a viewer connects on a busy machine, too.
const ARRIVAL: f64 = 12.0;

/// A server that waits this many seconds for viewers of its streams.
fn server(streaming: &str, arrival: f64) -> Builder {
    quick(demo_server(1))
        .set("streaming", streaming)
        .set("timing.arrival", arrival)
}

/// Whether the client hears within this time that its simulation ends.
async fn hears_an_end(client: &mut Client, time: Duration) -> bool {
    let heard = async {
        while let Heard::Text(text) = client.next().await {
            if text.starts_with("reason:") {
                break;
            }
        }
    };
    actix_rt::time::timeout(time, heard).await.is_ok()
}

/// The client's simulation ends because nobody watches it.
async fn ends(client: &mut Client) {
    // As long as it runs, texts come.
    client.within("loading: Error:", 2 * SOON).await;
    assert_eq!(client.reason()["code"], "no-viewer");
    assert_eq!(client.closed().await, Some(1000));
}

#[actix_rt::test]
async fn a_visitor_who_left_while_waiting_keeps_no_slot() {
    for streaming in ["direct", "relay"] {
        let server = server(streaming, 0.5).start().await;
        let mut before = Client::start(&server, &arm()).await;
        before.until("loading:").await;
        // Its page was left, and its connection is open.
        let mut left = Client::start(&server, &arm()).await;
        left.until("queue:").await;
        let mut next = Client::start(&server, &arm()).await;
        ends(&mut before).await;
        ends(&mut left).await;
        next.until("webots:").await;
        let metrics = server.metrics().await;
        assert!(metrics.contains("reason=\"no-viewer\"} 2"), "{metrics}");
        next.leave().await;
        nothing_left(&server, 1).await;
    }
}

#[actix_rt::test]
async fn a_simulation_with_a_viewer_goes_on_at_each_level() {
    let tries = levels()
        .into_iter()
        .flat_map(|level| ["direct", "relay"].map(|streaming| (level, streaming)));
    join_all(tries.map(|((level, user, network), streaming)| async move {
        let stage = Stage::new();
        let webots = Webots::launcher();
        let builder = stage.builder(&webots, level).before(user);
        let server = builder
            .set("sandbox.network", network)
            .set("streaming", streaming)
            .set("timing.arrival", ARRIVAL)
            .start()
            .await;
        let mut watched = Client::start(&server, &arm()).await;
        let told = watched.until("webots:").await;
        let url = told.trim_start_matches("webots:").replace("localhost", "127.0.0.1");
        let mut viewer = Some(Client::connect(&format!("{url}/")).await);
        if streaming == "relay" {
            // There, one that has been there is enough.
            viewer.take().unwrap().leave().await;
        }
        let mut unseen = Client::start(&server, &arm()).await;
        // It was ready later, so that the other's time is over, too.
        ends(&mut unseen).await;
        let rest = Duration::from_secs(1);
        assert!(!hears_an_end(&mut watched, rest).await, "{level} {network} {streaming}");
        drop(viewer);
    }))
    .await;
}

#[actix_rt::test]
async fn a_simulation_that_only_an_administrator_watches_goes_on() {
    for streaming in ["direct", "relay"] {
        let builder = server(streaming, ARRIVAL).set("maxConnections", 2);
        let server = builder.set("adminPassword", PASSWORD).start().await;
        let mut watched = Client::start(&server, &arm()).await;
        watched.until("webots:").await;
        let path = watched_by(&server, &watched).await;
        let _administrator = look_on(&server, &path).await;
        let mut unseen = Client::start(&server, &arm()).await;
        // It was ready later, so that the other's time is over, too.
        ends(&mut unseen).await;
        assert!(!hears_an_end(&mut watched, Duration::from_secs(1)).await, "{streaming}");
    }
}

#[actix_rt::test]
async fn the_time_begins_again_for_a_client_that_has_come_back() {
    let arrival = Duration::from_secs(2);
    let server = server("relay", arrival.as_secs_f64()).start().await;
    let (client, token) = Client::resumable(&server).await;
    drop(client);
    server.until_away(1).await;
    // Meanwhile the absence has its own time limit.
    actix_rt::time::sleep(arrival + Duration::from_secs(1)).await;
    assert_eq!(server.simulations().await.len(), 1);
    let back = Instant::now();
    let mut client = Client::resuming(&server, &token).await;
    client.until("webots:").await;
    ends(&mut client).await;
    assert!(back.elapsed() > arrival, "{:?}", back.elapsed());
}
