//! The session server's answers to web clients.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use super::stand_in::{Manner, StandIn};
use crate::support::client::Client;
use crate::support::git::world;
use crate::support::program::{demo_server, session_server};
use crate::support::{SOON, http, until};

#[actix_rt::test]
async fn a_client_is_led_to_the_simulation_server_that_is_there() {
    let simulation = demo_server(9).start().await;
    // Other load on this machine must not make the server full.
    let session = session_server(&[simulation.address()])
        .set("loadThreshold", 1000)
        .start()
        .await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    client.until("1").await;
    let address = format!("ws://{}", simulation.address());
    assert_eq!(http::get(&session.url("/request")).await.text(), "1");
    assert_eq!(http::get(&session.url("/session")).await.text(), address);
    let url = world("lab/arm", "main", "worlds/a.wbt");
    assert_eq!(
        http::get(&session.url(&format!("/session?url={url}"))).await.text(),
        address
    );
    client.send(&url).await;
    assert_eq!(client.until("ws").await, address);
    drop(simulation);
    client.until("0").await;
    until("the door is closed", async || {
        http::get(&session.url("/request")).await.text() == "0"
    })
    .await;
    let answer = http::get(&session.url("/session")).await;
    assert_eq!(answer.text(), "Error: no simulation server available at the moment.");
    assert_eq!(
        (answer.status.as_u16(), answer.header("retry-after")),
        (200, None),
        "as the Python server answers"
    );
    assert_eq!(answer.header("webots-reason"), Some("no-server-available"));
    // `Retry-After` varies, so that the clients of a class retry at different times.
    let mut seconds = BTreeSet::new();
    for _ in 0..20 {
        let answer = http::get(&session.url(&format!("/session?url={url}"))).await;
        assert_eq!(answer.text(), "Error: no simulation server available at the moment.");
        assert_eq!(answer.status, 503);
        assert_eq!(
            answer.header("access-control-expose-headers"),
            Some("Retry-After, Webots-Reason")
        );
        assert_eq!(answer.header("webots-reason"), Some("no-server-available"));
        seconds.insert(answer.header("retry-after").unwrap().parse::<u32>().unwrap());
    }
    assert!(
        seconds.len() > 1 && seconds.iter().all(|time| (2..=6).contains(time)),
        "{seconds:?}"
    );
}

#[actix_rt::test]
async fn a_message_may_come_in_pieces_and_must_not_be_large() {
    let other = serde_json::json!({"load": 1, "allowedRepositories": ["https://github.com/other"]});
    let server = StandIn::start(Manner::Status(other));
    let session = session_server(&[server.address()]).start().await;
    let connect = async || Client::connect(&session.websocket("/")).await;
    let mut client = connect().await;
    client.until("1").await;
    client
        .send_pieces(&[b"https://github.com/lab/arm", b"", b"/blob/main/worlds/a.wbt"])
        .await;
    assert_eq!(
        client.until("Error").await,
        "Error: no simulation server accepts https://github.com/lab/arm."
    );
    let piece = [b'x'; 5000];
    client.send_pieces(&[&piece, &piece]).await;
    assert_eq!(client.closed().await, Some(1009));
    let mut client = connect().await;
    client.send(&"x".repeat(9000)).await;
    assert_eq!(client.closed().await, Some(1009));
}

#[actix_rt::test]
async fn many_texts_at_once_are_answered_in_order_up_to_a_limit() {
    let server = StandIn::start(Manner::of_owner("other"));
    let session = session_server(&[server.address()]).start().await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    // It is '0' until the first answer of the simulation server.
    client.until("1").await;
    let told = client.heard.len();
    // Some answers are known at once; for others the connection asks the registry.
    let project = |number: usize| if number.is_multiple_of(2) { "lab" } else { "other" };
    let text = |number: usize| match number % 3 {
        0 => world("lab/arm", "main", &format!("worlds/{number}.txt")),
        _ => world(&format!("{}/p{number}", project(number)), "main", "worlds/a.wbt"),
    };
    for number in 0..=100 {
        client.send(&text(number)).await;
    }
    assert_eq!(client.closed().await, Some(1008));
    let heard = client.heard.split_off(told);
    let is_answer = |number: usize, answer: &str| match number % 3 {
        0 => answer.starts_with(&format!(
            "Error: Wrong Webots simulation URL: missing world file: \"{number}.txt\" is no world file"
        )),
        _ if number.is_multiple_of(2) => {
            answer == format!("Error: no simulation server accepts https://github.com/lab/p{number}.")
        }
        _ => answer == server.url(),
    };
    for (number, answer) in heard.iter().take(100).enumerate() {
        assert!(is_answer(number, answer), "{number}: {answer}");
    }
    assert_eq!(heard[100..], ["Error: too many requests on one connection."]);
}

#[actix_rt::test]
async fn a_draining_server_is_offered_for_less_than_a_second_more() {
    let server = demo_server(40).start().await;
    // As in deploy/swarm and deploy/kubernetes.
    let config = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/swarm/session.json")).unwrap();
    let config: serde_json::Value = serde_json::from_slice(&config).unwrap();
    let session = session_server(&[server.address()]).set("loadRefresh", config["loadRefresh"].clone());
    // Neither other tests on this machine nor the requests below make the server full.
    let session = session
        .set("loadThreshold", 1000)
        .set("clientCost", 0.001)
        .start()
        .await;
    let offered = async || http::get(&session.url("/session")).await.text().starts_with("ws://");
    until("it is offered", offered).await;
    let _client = Client::ready(&server).await;
    assert!(offered().await);

    server.signal(Signal::SIGUSR1);
    let drains = Instant::now();
    // If the machine is busy for a while, the requests of this test are late too: allow for that.
    let mut asked = drains;
    let mut held_up = Duration::ZERO;
    while offered().await {
        let last = asked;
        assert!(last.elapsed() < SOON, "it is offered for ever");
        assert!(
            last - drains < Duration::from_secs(1) + held_up,
            "offered to one who asked {:?} later",
            last - drains
        );
        actix_rt::time::sleep(Duration::from_millis(50)).await;
        asked = Instant::now();
        held_up = held_up.max(asked - last - Duration::from_millis(50));
    }
}
