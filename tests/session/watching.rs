//! How simulation servers are monitored, and that misbehaving ones do no harm.

use std::time::Duration;

use super::stand_in::{Manner, StandIn};
use super::{addresses, times_logged, until_states};
use crate::support::client::Client;
use crate::support::program::session_server;
use crate::support::stopwatch::Stopwatch;
use crate::support::{http, ports, until};

fn good() -> Manner {
    Manner::idle(5.0, 10)
}

fn load(text: &str) -> Manner {
    Manner::Load(text.to_owned())
}

fn json(text: &str) -> Manner {
    Manner::Body(200, text.as_bytes().to_vec())
}

/// Everything that is not a usable answer.
fn bad_manners() -> Vec<Manner> {
    vec![
        Manner::Hang,
        Manner::Reset,
        Manner::Drip,
        Manner::Raw(b"SSH-2.0-OpenSSH_9.2\r\n".to_vec()),
        Manner::Raw(b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\n{\"load\": 1".to_vec()),
        Manner::Raw(b"HTTP/1.0 200 OK\r\n\r\n{\"load\": 1".to_vec()),
        // Whole JSON that is cut off.
        Manner::Raw(b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\n{\"load\": 1}".to_vec()),
        Manner::Raw(b"HTTP/1.0 200 OK\r\n\r\n{\"load\": 1}".to_vec()),
        Manner::Raw([b"HTTP/1.1 200 OK\r\nX: ".to_vec(), vec![b'x'; 2_000_000]].concat()),
        Manner::Body(500, b"5.0".to_vec()),
        Manner::Body(302, b"5.0".to_vec()),
        Manner::Body(404, b"5.0".to_vec()),
        Manner::Body(200, vec![b' '; 10_000_000]),
        Manner::Body(200, vec![0xff; 100]),
        json(""),
        json("{}"),
        json("<html>5</html>"),
        json(r#"{"load": "5"}"#),
        json(r#"{"load": -1}"#),
        json(r#"{"load": 1e300}"#),
        json(r#"{"load": 1, "instances": {"places": -5}}"#),
        json(&"[".repeat(100_000)),
        load("NaN"),
        load("-1"),
        load("1e300"),
        load("5 %"),
        Manner::RawLoad(b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\n9".to_vec()),
        Manner::RawLoad(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n9\r\n".to_vec()),
        Manner::RawLoad(b"HTTP/1.0 200 OK\r\n\r\n9".to_vec()),
    ]
}

#[actix_rt::test]
async fn no_bad_answer_is_taken_for_a_good_one() {
    let bad = bad_manners();
    let servers: Vec<StandIn> = bad.iter().map(|_| StandIn::start(good())).collect();
    let session = session_server(&addresses(&servers))
        .set("timing", serde_json::json!({"answer": 3}))
        .start()
        .await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    client.until("1").await;
    until_states(&session, &vec!["up"; bad.len()]).await;
    for (server, manner) in servers.iter().zip(&bad) {
        server.set(manner.clone());
    }
    until_states(&session, &vec!["down"; bad.len()]).await;
    client.until("0").await;
    assert_eq!(http::get(&session.url("/load")).await.text(), "-1");
    // At least one more poll of each of them.
    let requests: Vec<usize> = servers.iter().map(StandIn::requests).collect();
    for (server, before) in servers.iter().zip(requests) {
        until("each server is looked at again", async || server.requests() > before).await;
    }
    assert_eq!(http::get(&session.url("/request")).await.text(), "0");
    for server in &servers {
        server.set(good());
    }
    client.until("1").await;
    until_states(&session, &vec!["up"; bad.len()]).await;
    for (server, manner) in servers.iter().zip(&bad) {
        let address = server.address();
        let logged = (
            times_logged(&session, &format!("{address}: down")),
            times_logged(&session, &format!("{address}: up")),
        );
        assert_eq!(logged, (1, 2), "{manner:?}");
    }
    assert_eq!(
        client.heard,
        ["0", "1", "0", "1"].map(str::to_owned)[usize::from(client.heard[0] == "1")..]
    );
}

#[actix_rt::test]
async fn a_crashed_server_is_noticed_within_one_refresh() {
    // One comes back on its port, which the system assigns to no other program in between.
    let port = ports::block(1);
    let mut servers = vec![
        StandIn::start_on(([127, 0, 0, 1], port).into(), good()),
        StandIn::start(good()),
    ];
    let session = session_server(&addresses(&servers)).set("loadRefresh", 1).start().await;
    let mut client = Client::connect(&session.websocket("/session")).await;
    until_states(&session, &["up", "up"]).await;
    let stopwatch = Stopwatch::start();
    let crash = stopwatch.lap();
    drop(servers.remove(0));
    until_states(&session, &["down", "up"]).await;
    assert!(
        crash.elapsed() < Duration::from_millis(1500),
        "noticed after {:?}",
        crash.elapsed()
    );
    for _ in 0..5 {
        assert_eq!(http::get(&session.url("/session")).await.text(), servers[0].url());
    }
    assert_eq!(client.until("1").await, "1");
    drop(servers);
    client.until("0").await;
    let _again = StandIn::start_on(([127, 0, 0, 1], port).into(), good());
    client.until("1").await;
    assert_eq!(client.heard.last().unwrap(), "1");
}

#[actix_rt::test]
async fn a_hung_server_is_noticed_in_time_and_delays_nobody() {
    let servers = [(); 10].map(|()| StandIn::start(Manner::idle(5.0, 1000)));
    let timing = serde_json::json!({"answer": 2, "placement": 0.2});
    // With this cost the requests of this test don't use up the capacity.
    let builder = session_server(&addresses(&servers))
        .set("timing", timing)
        .set("clientCost", 0.001);
    let session = builder.start().await;
    until_states(&session, &["up"; 10]).await;
    let stopwatch = Stopwatch::start();
    let hung = stopwatch.lap();
    servers[0].set(Manner::Hang);
    let states = ["down", "up", "up", "up", "up", "up", "up", "up", "up", "up"];
    while session
        .log()
        .matches(&format!("{}: down: no answer within 2 s", servers[0].address()))
        .count()
        == 0
    {
        let begin = stopwatch.lap();
        assert_eq!(http::get(&session.url("/session")).await.status, 200);
        assert!(
            begin.elapsed() < Duration::from_secs(1),
            "an answer took {:?}",
            begin.elapsed()
        );
        assert!(
            hung.elapsed() < Duration::from_secs(4),
            "not noticed after {:?}",
            hung.elapsed()
        );
        actix_rt::time::sleep(Duration::from_millis(10)).await;
    }
    let others: Vec<usize> = servers.iter().map(StandIn::requests).collect();
    until_states(&session, &states).await;
    for (server, before) in servers.iter().zip(others).skip(1) {
        until("the others are still asked", async || server.requests() > before).await;
        assert_eq!(server.connections(), 1);
    }
}
