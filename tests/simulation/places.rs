//! Slots and the queue.

use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::net::TcpListener;
use std::time::Duration;

use super::scene::nothing_left;
use crate::support::{Client, arm, demo_server, http, until};

#[actix_rt::test]
async fn on_a_quiet_machine_a_server_without_a_free_place_says_so_in_its_load() {
    let server = demo_server(1).start().await;
    let load = async || http::get(&server.url("/load")).await.text().parse::<f64>().unwrap();
    let page = async || http::get(&server.url("/monitor")).await.text();
    until("a free place", async || load().await < 99.0).await;
    let mut client = Client::start_from(&server, "203.0.113.9", &arm()).await;
    client.until("webots:").await;
    assert!(load().await >= 99.0);
    // Session servers that know slots learn from the real load.
    let reported = async || server.status().await["load"].as_f64().unwrap();
    until("the real load is reported", async || reported().await < 99.0).await;
    let shown = page().await;
    assert!(shown.contains("All places are taken."), "{shown}");
    let mut waits = Client::start_from(&server, "203.0.113.10", &arm()).await;
    waits.until("queue: 0").await;
    assert!(page().await.contains("All places are taken; clients wait in line."));
    client.leave().await;
    waits.until("webots:").await;
    waits.leave().await;
    until("the place is free", async || load().await < 99.0).await;
}

#[actix_rt::test]
async fn simulations_left_behind_make_room_for_who_waits() {
    let server = demo_server(8).start().await;
    let leave_behind = async |address| {
        let client = Client::from_address(&server, address).await.unwrap();
        let (client, token) = client.start_resumable().await;
        drop(client);
        token
    };
    let mut tokens = Vec::new();
    for _ in 0..7 {
        tokens.push(leave_behind("203.0.113.1").await);
    }
    let neighbour = leave_behind("203.0.113.2").await;
    server.until_away(8).await;
    // Somebody who asks gets a slot as soon as a simulation has ended, though each would wait a minute for its client.
    let mut others = Vec::new();
    for _ in 0..5 {
        let mut other = Client::start_from(&server, "203.0.113.3", &arm()).await;
        other.until("webots:").await;
        others.push(other);
    }
    // A quarter of the slots remains for the clients of one address that were away, those that left last.
    let mut waits = Client::start_from(&server, "203.0.113.3", &arm()).await;
    assert_eq!(waits.until("queue:").await, "queue: 0");
    let mut back = Client::resuming(&server, &tokens[5]).await;
    back.until("webots:").await;
    back.close_with(1000).await;
    waits.until("webots:").await;
    let mut late = Client::resuming(&server, &tokens[0]).await;
    let told = late.until("loading: Error:").await;
    assert!(told.contains("Others wait for a place"), "{told}");
    for token in [&tokens[6], &neighbour] {
        Client::resuming(&server, token).await.until("webots:").await;
    }
}

#[actix_rt::test]
async fn the_waiting_line_is_served_in_order_and_forgets_who_leaves() {
    let server = demo_server(2).set("waitingLine", 4).start().await;
    // A class behind one address gets all free slots and the whole queue.
    let start = async || Client::start_from(&server, "203.0.113.9", &arm()).await;
    let mut inside = Vec::new();
    for place in 1..=2 {
        let mut client = start().await;
        assert_eq!(
            client.until("webots:").await,
            format!("webots:ws://localhost:{}", server.port + place)
        );
        assert!(
            !client.heard.iter().any(|text| text.starts_with("queue")),
            "{:?}",
            client.heard
        );
        inside.push(client);
    }
    let mut line = Vec::new();
    for ahead in 0..4 {
        let mut client = start().await;
        assert_eq!(client.until("").await, format!("queue: {ahead}"));
        client.until("loading: waiting for a place").await;
        line.push(client);
    }
    let mut late = start().await;
    let told = late.until("").await;
    let words = "loading: Error: All 2 places of this simulation server are taken, and 4 clients are waiting already";
    assert!(told.starts_with(words), "{told}");
    assert_eq!(late.closed().await, Some(1000));
    // A client that leaves is removed from the queue at once, and only those behind it are notified.
    line.remove(1).leave().await;
    assert_eq!(line[1].until("queue:").await, "queue: 1");
    assert_eq!(line[2].until("queue:").await, "queue: 2");
    assert!(line[0].is_silent(Duration::from_millis(50)).await);
    let instances = server.status().await["instances"].clone();
    assert_eq!(
        (instances["queued"].as_u64(), instances["places"].as_u64()),
        (Some(3), Some(2))
    );
    assert_eq!(instances["arrivals"].as_u64(), Some(7));
    // The first in the queue gets the next free slot, with its port.
    inside.remove(1).leave().await;
    assert_eq!(
        line[0].until("webots:").await,
        format!("webots:ws://localhost:{}", server.port + 2)
    );
    assert_eq!(line[1].until("queue:").await, "queue: 0");
    assert_eq!(line[2].until("queue:").await, "queue: 1");
    for client in inside.into_iter().chain(line) {
        client.leave().await;
    }
    nothing_left(&server, 2).await;
}

#[actix_rt::test]
async fn one_address_leaves_places_and_a_part_of_the_line_to_others() {
    let builder = demo_server(4).set("waitingLine", 4);
    let server = builder.set("maxPlacesPerAddress", 3).start().await;
    let greedy = "2001:db8::1";
    let greedy_too = "2001:db8::2";
    let other = "2001:db8:0:1::1";
    let third = "203.0.113.11";
    let mut inside = Vec::new();
    for _ in 0..3 {
        let mut client = Client::start_from(&server, greedy, &arm()).await;
        client.until("webots:").await;
        inside.push(client);
    }
    let mut line = Vec::new();
    for ahead in 0..3 {
        let mut client = Client::start_from(&server, greedy, &arm()).await;
        assert_eq!(client.until("").await, format!("queue: {ahead}"));
        line.push(client);
    }
    // All addresses of a /64 count as one.
    let told = Client::start_from(&server, greedy_too, &arm()).await.until("").await;
    let words =
        "loading: Error: Clients of your address have 3 places of this simulation server, and 3 more are waiting";
    assert!(told.starts_with(words), "{told}");
    // Another address gets the fourth slot at once, although three clients wait, and the fourth place in the queue.
    let mut lucky = Client::start_from(&server, other, &arm()).await;
    assert_eq!(
        lucky.until("webots:").await,
        format!("webots:ws://localhost:{}", server.port + 4)
    );
    let mut late = Client::start_from(&server, third, &arm()).await;
    assert_eq!(late.until("").await, "queue: 3");
    let told = Client::start_from(&server, other, &arm()).await.until("").await;
    assert!(
        told.starts_with("loading: Error: All 4 places of this simulation server are taken"),
        "{told}"
    );
    // The next slot that the greedy address frees is for its first waiting client; slots of other addresses are not.
    lucky.leave().await;
    late.until("webots:").await;
    inside.remove(0).leave().await;
    line[0].until("webots:").await;
    assert_eq!(line[1].until("queue: 0").await, "queue: 0");
}

#[actix_rt::test]
async fn an_address_may_ask_only_so_often() {
    let server = demo_server(1).start().await;
    let ask = async |address: &str| {
        Client::start_from(&server, address, "https://github.com/none")
            .await
            .until("loading: Error:")
            .await
    };
    let mut asked = 1;
    let too_many = "loading: Error: Too many simulations were asked for from your address";
    while !ask("203.0.113.9").await.starts_with(too_many) {
        asked += 1;
        assert!(asked < 260, "it is never told to wait");
    }
    assert!(asked > 200, "{asked}");
    assert!(ask("203.0.113.10").await.contains("Wrong Webots simulation URL"));
}

#[actix_rt::test]
async fn a_port_that_somebody_else_has_is_not_lent() {
    let server = demo_server(2).start().await;
    let first = TcpListener::bind(("127.0.0.1", server.port + 1)).unwrap();
    let mut client = Client::start(&server, &arm()).await;
    assert_eq!(
        client.until("webots:").await,
        format!("webots:ws://localhost:{}", server.port + 2)
    );
    let mut second = Client::start(&server, &arm()).await;
    assert_eq!(second.until("").await, "queue: 0");
    drop(first);
    assert_eq!(
        second.until("webots:").await,
        format!("webots:ws://localhost:{}", server.port + 1)
    );
}

#[actix_rt::test]
async fn a_crowd_is_served_to_the_last_one_and_no_two_share_a_place() {
    let server = demo_server(3).start().await;
    let held = RefCell::new(BTreeSet::new());
    let were_all_held = Cell::new(false);
    let visits = (0..12).map(|_| async {
        let mut client = Client::start(&server, &arm()).await;
        let url = client.until("webots:").await;
        assert!(held.borrow_mut().insert(url.clone()), "{url} is another's");
        were_all_held.set(were_all_held.get() || held.borrow().len() == 3);
        until("all places are taken at once", async || were_all_held.get()).await;
        // Before it leaves, because leaving frees the slot.
        held.borrow_mut().remove(&url);
        client.leave().await;
        url
    });
    let urls = futures_util::future::join_all(visits).await;
    let allowed: Vec<String> = (1..=3)
        .map(|place| format!("webots:ws://localhost:{}", server.port + place))
        .collect();
    assert!(urls.iter().all(|url| allowed.contains(url)), "{urls:?}");
    nothing_left(&server, 3).await;
    until("all are counted", async || {
        server
            .metrics()
            .await
            .contains("webots_simulation_starts_total{outcome=\"ready\"} 12")
    })
    .await;
}
