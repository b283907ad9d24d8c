//! Requests of clients and pages, and their answers.

use super::scene::stages;
use crate::support::{Client, WORLD, Webots, arm, arm_at, demo_server, http, instances_below, server_of, until, world};

#[actix_rt::test]
async fn a_message_that_is_none_is_answered_in_words() {
    let server = demo_server(2).start().await;
    let mut running = Client::start(&server, &arm()).await;
    let url = running.until("webots:").await;
    let mut viewer = Client::connect(&format!("{}/", url.strip_prefix("webots:").unwrap()))
        .await
        .with_scene()
        .await;
    let of_git = |(_, words): &(i32, String)| words.contains("git");
    until("its checkout has ended", async || {
        !instances_below(&server.folder).iter().any(of_git)
    })
    .await;
    let processes = instances_below(&server.folder);
    assert!(processes.len() >= 2, "launcher and simulator");
    let start = |url: &str| serde_json::json!({"start": {"url": url}}).to_string();
    let table = [
        ("garbage".to_owned(), "Wrong message"),
        ("[".repeat(5000), "Wrong message"),
        (
            r#"{"start":{"url":"x","mode":"vr"}}"#.to_owned(),
            "start.mode: unknown variant `vr`, expected one of `x3d`",
        ),
        (start("https://github.com/lab/arm"), "Wrong Webots simulation URL"),
        (
            start("ftp://github.com/lab/arm/blob/main/worlds/a.wbt"),
            "does not begin with https://",
        ),
    ];
    for (text, words) in table {
        let mut client = Client::connect(&server.websocket("/client")).await;
        client.send(&text).await;
        let told = client.until("").await;
        assert!(
            told.starts_with("loading: Error: ") && told.contains(words),
            "{text}: {told}"
        );
        assert_eq!(client.closed().await, Some(1000));
    }
    // Text from a client is not interpreted as HTML.
    let image = "%3Cimg%20src=x%20onerror=alert(1)%3E";
    for url in [
        world("lab/arm", "main", &format!("worlds/{image}.wbt")),
        arm_at(image),
        world(&format!("lab/{image}"), "main", "worlds/a.wbt"),
        world("lab/arm", "main", &format!("worlds/{image}.txt")),
    ] {
        let mut client = Client::start(&server, &url).await;
        client.until("loading: Error: ").await;
        let html = client.heard.iter().find(|text| text.contains(['<', '>', '&']));
        assert!(
            html.is_none() && client.heard.iter().any(|text| text.contains("\u{2039}img")),
            "{:?}",
            client.heard
        );
    }
    until("the others are gone", async || stages(&server).await.len() == 1).await;
    assert_eq!(instances_below(&server.folder), processes);
    viewer.send("pause").await;
    viewer.until("paused by client").await;
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
        assert_eq!(
            client.until("").await,
            "loading: Error: Wrong message: allowed are short texts"
        );
        assert_eq!(client.closed().await, Some(1003));
    }
}

#[actix_rt::test]
async fn messages_in_pieces_too_early_or_again_and_again_do_no_harm() {
    let server = demo_server(2).start().await;
    let text = serde_json::json!({"start": {"url": arm()}, "é": "é".repeat(3000)}).to_string();
    let mut client = Client::connect(&server.websocket("/client")).await;
    // A reset that comes too early does not close the connection.
    let refused = "loading: Error: A controller can be reset only while a simulation runs";
    let reset = r#"{"reset controller": "c/c.py"}"#;
    client.send(reset).await;
    assert_eq!(client.until("").await, refused);
    let pieces: Vec<&[u8]> = text.as_bytes().chunks(1001).collect();
    assert!(pieces.len() > 5);
    client.send_pieces(&pieces).await;
    client.send(reset).await;
    client.until(refused).await;
    client.until("webots:").await;
    client
        .send_pieces(&[b"{\"reset controller\": ", b"", b"\"c/c.py\"}"])
        .await;
    client.until("reset controller: c/c.py").await;
    let start = serde_json::json!({"start": {"url": arm()}}).to_string();
    client.send(&start).await;
    until("it is logged", async || {
        server.log().contains("second simulation on one connection; ignored")
    })
    .await;
    assert_eq!(stages(&server).await.len(), 1);
    // A client that sends requests without reading is disconnected.
    for _ in 0..150 {
        client.send(&start).await;
    }
    assert_eq!(client.closed().await, Some(1008));
    until("it is gone", async || stages(&server).await.is_empty()).await;
}

#[actix_rt::test]
async fn connections_are_bounded() {
    let server = demo_server(1).set("maxClients", 2).start().await;
    let one = Client::connect(&server.websocket("/client")).await;
    let _other = Client::connect(&server.websocket("/client")).await;
    let third = async || Client::with_headers(&server.websocket("/client"), &[]).await;
    assert_eq!(third().await.err(), Some(503));
    one.leave().await;
    until("there is room", async || third().await.is_ok()).await;
    // One address leaves some connections to others.
    let server = demo_server(1).set("maxClients", 4).start().await;
    let connect = async |address| Client::from_address(&server, address).await;
    let greedy = [
        connect("203.0.113.9").await,
        connect("203.0.113.9").await,
        connect("203.0.113.9").await,
    ];
    assert!(greedy.iter().all(Result::is_ok));
    assert_eq!(connect("203.0.113.9").await.err(), Some(429));
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
    assert_eq!(
        (one["stage"].as_str(), one["version"].as_str()),
        (Some("idle"), Some("R2025a"))
    );
    assert_eq!(one["port"], server.port + 1);
    assert_eq!((&status["docker"], &status["draining"]), (&false.into(), &false.into()));
    assert_eq!(
        status["allowedRepositories"],
        serde_json::json!(["https://github.com/lab"])
    );
    assert_eq!(status["version"], env!("CARGO_PKG_VERSION"));
    assert!(status["machine"]["memory"].is_number() && status["host"]["threads"].as_u64() > Some(0));
    let page = server.monitor().await;
    assert!(page.contains("github.com/lab/arm") && page.contains("idle"), "{page}");
}

#[actix_rt::test]
async fn a_client_receives_the_kind_of_the_scene_right_before_its_url() {
    let webots = Webots::launcher();
    let resources = webots.path().with_file_name("resources");
    let server = server_of(webots, 1).set("timing.heartbeat", 0.2).start().await;
    let old = WORLD.replace("R2025a", "R2023b");
    server.forge().commit("lab/arm", "old", &[("worlds/a.wbt", &old)]);
    // An installed Webots opens worlds of other releases too.
    for (installed, reference, kind) in [
        (None, "main", "kind: w3d"),
        (None, "old", "kind: x3d"),
        (Some("R2025a\n"), "old", "kind: w3d"),
        (Some("R2022b revision 1\n"), "main", "kind: x3d"),
    ] {
        if let Some(release) = installed {
            std::fs::create_dir_all(&resources).unwrap();
            std::fs::write(resources.join("version.txt"), release).unwrap();
        }
        let mut client = Client::start(&server, &arm_at(reference)).await;
        client.until("webots:").await;
        let [.., before, _] = &client.heard[..] else {
            panic!("{:?}", client.heard)
        };
        assert_eq!(before, kind, "{installed:?} {reference}");
        client.leave().await;
        until("it is gone", async || stages(&server).await.is_empty()).await;
    }
}
