//! The simulation servers to which clients are sent.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::stand_in::{Manner, StandIn};
use super::{addresses, times_logged, until_states};
use crate::support::client::Client;
use crate::support::git::world;
use crate::support::program::{Builder, Server, session_server};
use crate::support::{http, until};

const NOBODY: &str = "Error: no simulation server available at the moment.";

/// A session server whose simulation servers report only once, so that the test runs between two reports.
fn between_reports(servers: &[StandIn], client_cost: f64) -> Builder {
    session_server(&addresses(servers))
        .set("loadRefresh", 600)
        .set("clientCost", client_cost)
}

/// Sends `count` requests; returns how many clients each server got.
async fn requests(session: &Server, count: usize) -> BTreeMap<String, usize> {
    let client = awc::Client::default();
    let mut got = BTreeMap::new();
    let next = async || {
        let mut answer = client.get(session.url("/session")).send().await.unwrap();
        String::from_utf8(answer.body().await.unwrap().to_vec()).unwrap()
    };
    for _ in 0..count.div_ceil(20) {
        for text in futures_util::future::join_all((0..20).map(|_| next())).await {
            *got.entry(text).or_default() += 1;
        }
    }
    got
}

#[actix_rt::test]
async fn a_burst_between_two_reports_is_spread_evenly() {
    let servers = [(); 5].map(|()| StandIn::start(Manner::idle(3.0, 1000)));
    let session = between_reports(&servers, 0.05).start().await;
    until_states(&session, &["up"; 5]).await;
    let got = requests(&session, 1000).await;
    let expected = servers.iter().map(|server| (server.url(), 200)).collect();
    assert_eq!(got, expected);
}

#[actix_rt::test]
async fn a_server_without_a_free_slot_gets_nobody() {
    let servers = [
        Manner::status(10.0, 4, 4),
        Manner::status(91.0, 9, 100),
        Manner::status(60.0, 2, 4),
    ];
    let servers = servers.map(StandIn::start);
    let session = between_reports(&servers, 10.0).start().await;
    until_states(&session, &["full", "full", "up"]).await;
    let mut client = Client::connect(&session.websocket("/")).await;
    client.until("1").await;
    assert_eq!(times_logged(&session, "full: load 91.0 % of 90.0 %"), 1);
    for _ in 0..2 {
        assert_eq!(http::get(&session.url("/session")).await.text(), servers[2].url());
    }
    client.until("0").await;
    assert_eq!(http::get(&session.url("/request")).await.text(), "0");
    assert_eq!(http::get(&session.url("/session")).await.text(), NOBODY);
}

#[actix_rt::test]
async fn a_world_goes_only_where_it_will_be_accepted() {
    // One has never answered; no client waits for it.
    let servers = [Manner::of_owner("lab"), Manner::of_owner("school"), Manner::Reset].map(StandIn::start);
    let session = session_server(&addresses(&servers)).start().await;
    until_states(&session, &["up", "up", "down"]).await;
    let session_for = async |url: &str| http::get(&session.url(&format!("/session?url={url}"))).await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    client.until("1").await;
    for (owner, server) in ["lab", "school"].into_iter().zip(&servers) {
        let url = world(&format!("{owner}/arm"), "main", "worlds/a.wbt");
        for _ in 0..3 {
            assert_eq!(session_for(&url).await.text(), server.url());
            let encoded = format!("{}&mode=x3d", url.replace(':', "%3A").replace('/', "%2F"));
            assert_eq!(session_for(&encoded).await.text(), server.url());
            client.send(&url).await;
            assert_eq!(client.until("").await, server.url());
            client.send(&serde_json::json!({"url": url}).to_string()).await;
            assert_eq!(client.until("").await, server.url());
        }
    }
    let url = world("stranger/arm", "main", "worlds/a.wbt");
    let refused = session_for(&url).await;
    let words = "Error: no simulation server accepts https://github.com/stranger/arm.";
    assert_eq!((refused.status.as_u16(), refused.text().as_str()), (403, words));
    assert_eq!(refused.header("webots-reason"), Some("repository-not-allowed"));
    client.send(&url).await;
    assert_eq!(client.until("").await, words);
    // The reason comes only to a client that asks for it.
    client.send(&json!({"url": url, "reason": true}).to_string()).await;
    let reason = client.until("reason: ").await;
    let reason: Value = serde_json::from_str(reason.strip_prefix("reason: ").unwrap()).unwrap();
    let expected = json!({"code": "repository-not-allowed", "blame": "user", "retry": "no"});
    assert_eq!((reason, client.until("").await.as_str()), (expected, words));
    let wrong = session_for("https://github.com/lab").await;
    assert_eq!(wrong.status, 400);
    assert_eq!(wrong.header("webots-reason"), Some("invalid-world"));
    assert!(wrong.text().starts_with("Error: "), "{}", wrong.text());
    client.send(r#"{"url": 5}"#).await;
    client.until("Error: ").await;
}

#[actix_rt::test]
async fn a_dedicated_server_comes_first_and_no_burst_exceeds_a_shared_idle_time() {
    let status = |owner: &str, load: f64, share: f64| {
        let allowed = [format!("https://github.com/{owner}")];
        Manner::Status(
            json!({"load": load, "instances": {"places": 100}, "docker": share > 0.0, "shareIdleTime": share,
            "allowedRepositories": allowed}),
        )
    };
    let servers = [status("lab", 60.0, 0.0), status("school", 25.0, 50.0)].map(StandIn::start);
    let url = |owner: &str| world(&format!("{owner}/arm"), "main", "worlds/a.wbt");
    // The lab's server has a higher load. The other one exceeds 50 % with the third client.
    let expected = [("lab", 0, 2), ("stranger", 1, 3)];
    let session = between_reports(&servers, 10.0).start().await;
    until_states(&session, &["up", "up"]).await;
    let ask = async |owner: &str| http::get(&session.url(&format!("/session?url={}", url(owner)))).await;
    for (owner, server, clients) in expected {
        for _ in 0..clients {
            assert_eq!(ask(owner).await.text(), servers[server].url());
        }
    }
    assert_eq!(ask("stranger").await.header("webots-reason"), Some("no-idle-time"));
    // The same by the line.
    let session = between_reports(&servers, 10.0).start().await;
    until_states(&session, &["up", "up"]).await;
    let wait = async |owner: &str| {
        let mut client = Client::connect(&session.websocket("/session")).await;
        client.send(&json!({"url": url(owner), "wait": true}).to_string()).await;
        client
    };
    for (owner, server, clients) in expected {
        for _ in 0..clients {
            assert_eq!(wait(owner).await.until("ws://").await, servers[server].url());
        }
    }
    let mut waits = wait("stranger").await;
    assert_eq!(waits.until("queue: ").await, "queue: 0");
    assert!(
        !waits.heard.iter().any(|text| text.starts_with("ws://")),
        "{:?}",
        waits.heard
    );
}

#[actix_rt::test]
async fn somebody_who_only_asks_does_not_close_the_fleet() {
    let counting = json!({"load": 10, "instances": {"queued": 0, "starting": 0, "idle": 0, "running": 0, "places": 100,
        "arrivals": 0}});
    let servers = [StandIn::start(Manner::Status(counting))];
    // The tests' own address is that of a trusted proxy, which names its clients. There is room for 43 clients.
    let session = session_server(&addresses(&servers))
        .set("timing", json!({"placement": 0.5}))
        .start()
        .await;
    until_states(&session, &["up"]).await;
    let url = session.url("/session");
    let client = awc::Client::default();
    let ask = async || {
        let request = client.get(&url).insert_header(("X-Forwarded-For", "203.0.113.9"));
        request
            .send()
            .await
            .unwrap()
            .body()
            .await
            .unwrap()
            .starts_with(b"ws://")
    };
    let burst = async || futures_util::future::join_all((0..50).map(|_| ask())).await;
    // The address uses up its quota.
    let mut refused = 0;
    until(
        "it has asked for what closes the fleet, and is refused no longer",
        async || {
            let answers = burst().await;
            refused += answers.iter().filter(|placed| !**placed).count();
            refused > 0 && answers.iter().all(|placed| *placed)
        },
    )
    .await;
    // From then on, no number of requests closes the fleet.
    for _ in 0..10 {
        assert!(burst().await.iter().all(|placed| *placed));
    }
}
