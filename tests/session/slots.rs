//! The WebSocket `/slots` to simulation servers that lie, send too much or have none: others, and the line, are not
//! disturbed.

use std::time::{Duration, Instant};

use serde_json::json;
use webots_fleet::shared::domain::{Offer, Offers, ReservationId};

use super::fleet_line::place;
use super::stand_in::{Manner, StandIn};
use super::{times_logged, until_states};
use crate::support::client::Client;
use crate::support::git::arm;
use crate::support::http::{PASSWORD, get_as_administrator};
use crate::support::program::{Server, demo_server, session_server};
use crate::support::reserving::ReservingServer;
use crate::support::{SOON, until};

const SECRET: &str = "a secret of this test";

/// A client in the line.
async fn enter(session: &Server) -> Client {
    let mut client = Client::connect(&session.websocket("/session")).await;
    client.send(&json!({"url": arm(), "wait": true}).to_string()).await;
    client.until("ticket: ").await;
    client
}

#[actix_rt::test]
async fn a_server_that_lies_and_floods_disturbs_no_other_and_no_turn() {
    let honest = demo_server(1).set("fleetKey", SECRET).start().await;
    let inside = Client::ready(&honest).await;
    // Its reservations hold longer than any clock can count.
    let mut liar = ReservingServer::start(1, 1e18).await;
    liar.report(1, 1);
    let session = session_server(&[honest.address(), liar.address.clone()])
        .set("fleetKey", SECRET)
        .set("loadThreshold", 1000)
        .set("adminPassword", PASSWORD)
        .start()
        .await;
    until_states(&session, &["full", "full"]).await;
    let mut link = liar.link().await;
    let mut first = enter(&session).await;
    let wishes = link.wishes().await.unwrap();
    link.reserve(wishes.number, [wishes.first[0].ticket]).await;
    first.until("pass: ").await;
    assert_eq!(first.until("ws://").await, format!("ws://{}", liar.address));
    let mut second = enter(&session).await;
    assert_eq!(second.until("queue: ").await, "queue: 0");
    // Slots for tickets that nobody has, answers to what nobody asked, times before the world began.
    for number in 0..200 {
        let offer = |ticket| Offer {
            ticket,
            reservation: ReservationId(ticket),
        };
        let offers = Offers {
            number: u64::MAX - number,
            offers: (0..500).map(offer).collect(),
            free: u32::MAX,
            used: (0..500).map(ReservationId).collect(),
            queue: vec![u64::MAX; 100],
            passed: Vec::new(),
        };
        assert!(link.offer(&offers).await, "{number}");
    }
    // What is too long, or no offer, ends the link, which is opened again.
    link.say("x".repeat(1 << 20)).await;
    let mut link = liar.link().await;
    link.say("[]".to_owned()).await;
    let mut link = liar.link().await;
    // So does a list of more simulations than memory should hold.
    let simulation =
        |id: usize| json!({"id": id.to_string(), "world": "x".repeat(100_000), "state": "running", "since": 1});
    for part in 0..100 {
        let simulations: Vec<_> = (10 * part..10 * (part + 1)).map(simulation).collect();
        link.say(json!({"roster": {"all": false, "simulations": simulations, "ended": []}}).to_string())
            .await;
    }
    let mut link = liar.link().await;
    let list = get_as_administrator(&session.url("/simulations")).await.json();
    let of_liar = list
        .as_array()
        .unwrap()
        .iter()
        .filter(|one| one["server"] == liar.address);
    assert_eq!(of_liar.count(), 0);
    // Pings are answered, but no faster than other messages.
    let begin = Instant::now();
    link.ping(300).await;
    assert!(begin.elapsed() >= Duration::from_millis(300), "{:?}", begin.elapsed());
    inside.leave().await;
    second.until("pass: ").await;
    assert_eq!(second.until("ws://").await, format!("ws://{}", honest.address()));
    assert_eq!(session.status().await["line"]["waiting"], 0);
}

#[actix_rt::test]
async fn a_link_that_breaks_at_its_begin_is_opened_again_and_blames_no_key() {
    let mut server = ReservingServer::start(1, 10.0).await;
    server.break_next(3);
    let session = session_server(&[server.address.clone()])
        .set("fleetKey", SECRET)
        .start()
        .await;
    server.link().await;
    assert_eq!(server.breaks_left(), 0);
    assert!(!session.log().contains("fleetKey is another one"), "{}", session.log());
}

#[actix_rt::test]
async fn a_server_whose_slots_cant_be_asked_for_takes_its_turn_by_its_reports() {
    // As behind a proxy that passes no WebSockets on.
    let status = json!({"load": 1, "reserves": true, "instances": {"running": 0, "places": 5}});
    let server = StandIn::start(Manner::Status(status));
    let session = session_server(&[server.address()])
        .set("fleetKey", SECRET)
        .start()
        .await;
    until_states(&session, &["up"]).await;
    for _ in 0..2 {
        let mut client = enter(&session).await;
        assert_eq!(client.within("ws://", SOON).await, server.url());
        assert!(
            !client.heard.iter().any(|text| text.starts_with("pass:")),
            "{:?}",
            client.heard
        );
    }
    assert_eq!(
        times_logged(&session, "its /slots can't be used"),
        1,
        "{}",
        session.log()
    );
}

#[actix_rt::test]
async fn idle_time_is_shared_up_to_the_load_that_a_server_will_have() {
    let mut server = ReservingServer::start(100, 10.0).await;
    let report = |load: f64, running: u32| {
        server.report_also(json!({"load": load, "docker": true, "shareIdleTime": 50,
            "allowedRepositories": ["https://github.com/school"],
            "instances": {"running": running, "places": 100}}));
    };
    report(70.0, 10);
    let session = session_server(&[server.address.clone()])
        .set("fleetKey", SECRET)
        .start()
        .await;
    until_states(&session, &["up"]).await;
    let mut clients = Vec::new();
    for _ in 0..12 {
        clients.push(enter(&session).await);
    }
    // Ten have left, and the load shows them for five seconds more. A client costs 2 %.
    report(55.0, 0);
    let mut link = server.link().await;
    let wishes = link.wishes().await.unwrap();
    link.reserve(wishes.number, [wishes.first[0].ticket]).await;
    clients[0].within("pass: ", SOON).await;
    assert!(wishes.first.len() < clients.len(), "{wishes:?}");
}

#[actix_rt::test]
async fn who_asks_again_when_its_turn_comes_and_leaves_does_not_stay_in_the_line() {
    let mut server = ReservingServer::start(1, 10.0).await;
    let session = session_server(&[server.address.clone()])
        .set("fleetKey", SECRET)
        .set("loadThreshold", 1000)
        .start()
        .await;
    until_states(&session, &["up"]).await;
    let mut link = server.link().await;
    // The turn meets the second request now and then.
    for _ in 0..100 {
        let mut client = Client::connect(&session.websocket("/session")).await;
        let request = json!({"url": arm(), "wait": true}).to_string();
        client.send(&request).await;
        let (_, ticket) = place(&client.until("ticket: ").await.replace("ticket: ", ""));
        let wishes = loop {
            let wishes = link.wishes().await.unwrap();
            if wishes.first.iter().any(|wish| wish.ticket == ticket) {
                break wishes;
            }
            link.reserve(wishes.number, []).await;
        };
        link.reserve(wishes.number, [ticket]).await;
        client.send(&request).await;
        client.until("ticket: ").await;
        client.leave().await;
    }
    until("nobody waits any more", async || {
        session.status().await["line"]["waiting"] == 0
    })
    .await;
}
