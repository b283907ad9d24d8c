//! What clients and pages may ask, and what they are told.

use tokio_tungstenite::tungstenite::client::IntoClientRequest;

use super::scene::{arm, stages};
use crate::support::client::Client;
use crate::support::git::{Forge, world};
use crate::support::http;
use crate::support::program::{Server, demo_server, simulation_server};
use crate::support::until;
use crate::support::webots::{Webots, instances_below};

#[actix_rt::test]
async fn a_message_that_is_none_is_answered_in_words() {
    let server = demo_server(2).start().await;
    let (_running, mut viewer, processes) = running(&server).await;
    let start = |url: &str| serde_json::json!({"start": {"url": url}}).to_string();
    let table = [
        ("garbage".to_owned(), "Wrong message"),
        ("[".repeat(5000), "Wrong message"),
        (r#"{"start":{"url":"x","mode":"vr"}}"#.to_owned(), "start.mode: unknown variant `vr`, expected one of `x3d`"),
        (start("https://github.com/lab/arm"), "Wrong Webots simulation URL"),
        (start("ftp://github.com/lab/arm/blob/main/worlds/a.wbt"), "does not begin with https://"),
    ];
    for (text, words) in table {
        let mut client = Client::connect(&server.websocket("/client")).await;
        client.send(&text).await;
        let told = client.until("").await;
        assert!(told.starts_with("loading: Error: ") && told.contains(words), "{text}: {told}");
        assert_eq!(client.closed().await, Some(1000));
    }
    goes_on(&server, &mut viewer, &processes).await;
}

/// A client whose simulation runs, a viewer of it, and its processes.
async fn running(server: &Server) -> (Client, Client, Vec<i32>) {
    let mut client = Client::start(server, &arm()).await;
    let url = client.until("webots:").await;
    let viewer = Client::connect(&format!("{}/", url.strip_prefix("webots:").unwrap())).await.with_scene().await;
    let processes = processes(server);
    assert!(processes.len() >= 2, "launcher and simulator");
    (client, viewer, processes)
}

fn processes(server: &Server) -> Vec<i32> {
    instances_below(&server.folder).into_iter().map(|(pid, _)| pid).collect()
}

/// Whether that simulation is the only one and has its processes, and whether its viewer is answered.
async fn goes_on(server: &Server, viewer: &mut Client, before: &[i32]) {
    until("the others are gone", async || stages(server).await.len() == 1).await;
    assert_eq!(processes(server), before);
    viewer.send("pause").await;
    viewer.until("paused by client").await;
}

#[actix_rt::test]
async fn no_text_to_a_client_is_html() {
    let server = demo_server(2).start().await;
    let image = "%3Cimg%20src=x%20onerror=alert(1)%3E";
    for url in [
        world("lab/arm", "main", &format!("worlds/{image}.wbt")),
        world("lab/arm", image, "worlds/a.wbt"),
        world(&format!("lab/{image}"), "main", "worlds/a.wbt"),
        world("lab/arm", "main", &format!("worlds/{image}.txt")),
    ] {
        let mut client = Client::start(&server, &url).await;
        client.until("loading: Error: ").await;
        let html = client.heard.iter().find(|text| text.contains(['<', '>', '&']));
        assert!(html.is_none() && client.heard.iter().any(|text| text.contains("\u{2039}img")), "{:?}", client.heard);
    }
}

#[actix_rt::test]
async fn oversized_and_binary_messages_end_the_connection_in_words() {
    let server = demo_server(2).start().await;
    let connect = async || Client::connect(&server.websocket("/client")).await;
    let large = "loading: Error: Wrong message: it is longer than 8 KiB";
    let piece = [b'x'; 5000];
    let mut clients = [connect().await, connect().await, connect().await];
    clients[0].send(&"x".repeat(9000)).await;
    clients[1].send_pieces(&[&piece, &piece]).await;
    clients[2].send(&"x".repeat(200_000)).await;
    for mut client in clients {
        assert_eq!(client.until("").await, large);
        assert_eq!(client.closed().await, Some(1009));
    }
    let mut clients = [connect().await, connect().await];
    clients[0].send_binary(&[0; 10]).await;
    clients[1].send_pieces(&[b"\xff", b"\xff"]).await;
    for mut client in clients {
        assert_eq!(client.until("").await, "loading: Error: Wrong message: allowed are short texts");
        assert_eq!(client.closed().await, Some(1003));
    }
}

#[actix_rt::test]
async fn a_message_may_come_in_pieces() {
    let server = demo_server(2).start().await;
    let text = serde_json::json!({"start": {"url": arm()}, "é": "é".repeat(3000)}).to_string();
    let mut client = Client::connect(&server.websocket("/client")).await;
    let pieces: Vec<&[u8]> = text.as_bytes().chunks(1001).collect();
    assert!(pieces.len() > 5);
    client.send_pieces(&pieces).await;
    client.until("webots:").await;
    client.send_pieces(&[b"{\"reset controller\": ", b"", b"\"c/c.py\"}"]).await;
    client.until("reset controller: c/c.py").await;
}

#[actix_rt::test]
async fn a_reset_that_comes_too_early_ends_nothing() {
    let server = demo_server(2).start().await;
    let mut client = Client::connect(&server.websocket("/client")).await;
    let refused = "loading: Error: A controller can be reset only while a simulation runs";
    let reset = r#"{"reset controller": "c/c.py"}"#;
    client.send(reset).await;
    assert_eq!(client.until("").await, refused);
    client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
    client.send(reset).await;
    client.until(refused).await;
    client.until("webots:").await;
}

#[actix_rt::test]
async fn who_asks_without_reading_is_sent_away() {
    let server = demo_server(2).start().await;
    let mut client = Client::ready(&server).await;
    for _ in 0..150 {
        client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
    }
    assert_eq!(client.closed().await, Some(1008));
    until("it is gone", async || super::scene::stages(&server).await.is_empty()).await;
}

#[actix_rt::test]
async fn a_second_start_on_a_connection_is_ignored() {
    let server = demo_server(2).start().await;
    let mut client = Client::ready(&server).await;
    client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
    until("it is logged", async || server.log().contains("second simulation on one connection; ignored")).await;
    assert_eq!(super::scene::stages(&server).await.len(), 1);
}

#[actix_rt::test]
async fn only_pages_of_allowed_origins_may_start_simulations() {
    let builder = demo_server(1);
    let server = builder.set("allowedOrigins", serde_json::json!(["https://lab.org"])).start().await;
    for (origin, allowed) in
        [(Some("https://lab.org"), true), (Some("https://evil.org"), false), (Some("null"), false), (None, true)]
    {
        let mut request = server.websocket("/client").into_client_request().unwrap();
        if let Some(origin) = origin {
            request.headers_mut().insert("origin", origin.parse().unwrap());
        }
        let result = tokio_tungstenite::connect_async(request).await;
        assert_eq!(result.is_ok(), allowed, "{origin:?}");
        if let Err(tokio_tungstenite::tungstenite::Error::Http(answer)) = result {
            assert_eq!(answer.status(), 403);
        }
    }
}

#[actix_rt::test]
async fn connections_are_bounded() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 1).set("maxClients", 2).start().await;
    let one = Client::connect(&server.websocket("/client")).await;
    let _other = Client::connect(&server.websocket("/client")).await;
    let third = tokio_tungstenite::connect_async(server.websocket("/client")).await;
    assert!(matches!(third, Err(tokio_tungstenite::tungstenite::Error::Http(answer)) if answer.status() == 503));
    one.leave().await;
    until("there is room", async || tokio_tungstenite::connect_async(server.websocket("/client")).await.is_ok()).await;
    // One address leaves some to others.
    let server = simulation_server(&webots.path(), forge.path(), 1).set("maxClients", 4).start().await;
    let connect = async |address| Client::try_from_address(&server, address).await;
    let greedy = [connect("203.0.113.9").await, connect("203.0.113.9").await, connect("203.0.113.9").await];
    assert!(greedy.iter().all(Result::is_ok));
    let refused = connect("203.0.113.9").await.map(drop).unwrap_err();
    assert!(matches!(&*refused, tokio_tungstenite::tungstenite::Error::Http(answer) if answer.status() == 429));
    connect("203.0.113.10").await.unwrap();
}

#[actix_rt::test]
async fn pages_tell_what_they_should() {
    let server = demo_server(2).start().await;
    let load = http::get(&server.url("/load")).await;
    assert!(load.text().parse::<f64>().unwrap() >= 0.0);
    assert_eq!(load.header("access-control-allow-origin"), Some("*"));
    let none = http::get(&server.url("/none")).await;
    assert_eq!(none.status, 404);
    let options = awc::Client::new().options(server.url("/load")).send().await.unwrap();
    assert_eq!(options.status(), 204);
    let _client = Client::ready(&server).await;
    let status = server.status().await;
    let one = &status["simulations"][0];
    assert_eq!(one["world"], arm());
    assert_eq!((one["stage"].as_str(), one["version"].as_str()), (Some("idle"), Some("R2025a")));
    assert_eq!(one["port"], server.port + 1);
    assert_eq!((&status["docker"], &status["draining"]), (&false.into(), &false.into()));
    assert_eq!(status["allowedRepositories"], serde_json::json!(["https://github.com/lab"]));
    assert_eq!(status["version"], env!("CARGO_PKG_VERSION"));
    assert!(status["machine"]["memory"].is_number() && status["host"]["threads"].as_u64() > Some(0));
    let page = server.monitor().await;
    assert!(page.contains("github.com/lab/arm") && page.contains("idle"), "{page}");
}

#[actix_rt::test]
async fn outcomes_are_counted() {
    let server = demo_server(1).set("waitingLine", 1).start().await;
    let count = async |name: &str| {
        let text = server.metrics().await;
        let name = format!("webots_simulation_{name} ");
        text.lines().find_map(|line| line.strip_prefix(&name)).unwrap().parse::<u32>().unwrap()
    };
    assert_eq!(count("starts_total{outcome=\"ready\"}").await, 0);
    let ready = Client::ready(&server).await;
    let mut waits = Client::start(&server, &arm()).await;
    waits.until("queue: 0").await;
    Client::start(&server, &arm()).await.until("loading: Error: All 1 places").await;
    Client::start(&server, &world("other/x", "main", "worlds/a.wbt")).await.until("loading: Error:").await;
    waits.leave().await;
    ready.leave().await;
    super::scene::nothing_left(&server, 1).await;
    Client::start(&server, &world("lab/none", "main", "worlds/a.wbt")).await.until("loading: Error:").await;
    for (counter, expected) in [
        ("starts_total{outcome=\"ready\"}", 1),
        ("starts_total{outcome=\"full\"}", 1),
        ("starts_total{outcome=\"refused\"}", 1),
        ("ends_total{reason=\"left\"}", 2),
        ("ends_total{reason=\"no_checkout\"}", 1),
        ("ends_total{reason=\"no_webots\"}", 0),
    ] {
        until(counter, async || count(counter).await == expected).await;
    }
}
