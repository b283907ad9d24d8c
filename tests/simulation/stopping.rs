//! Starting, draining and stopping the server; announcements.

use std::net::TcpListener;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::json;

use super::scene::stages;
use crate::support::listener::{Request, listen};
use crate::support::{Builder, Client, SOON, arm, demo_server, http, until};

#[actix_rt::test]
async fn a_draining_server_ends_with_its_last_client() {
    // Container orchestrators pass passwords in files.
    let secret = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(secret.path(), "secret\n").unwrap();
    for by in ["signal", "page"] {
        let builder = demo_server(1);
        let mut server = builder
            .set("adminPassword", json!({"file": secret.path()}))
            .start()
            .await;
        let mut running = Client::start(&server, &arm()).await;
        let stream = running.until("webots:").await["webots:".len()..].to_owned();
        let mut waiting = Client::start(&server, &arm()).await;
        waiting.until("queue: 0").await;
        let drain = |password: &'static str| {
            awc::Client::new()
                .post(server.url("/drain"))
                .basic_auth("admin", password)
                .send()
        };
        if by == "signal" {
            server.signal(Signal::SIGUSR1);
        } else {
            assert_eq!(drain("wrong").await.unwrap().status(), 401);
            assert_eq!(
                awc::Client::new()
                    .post(server.url("/drain"))
                    .send()
                    .await
                    .unwrap()
                    .status(),
                401
            );
            assert_eq!(server.status().await["draining"], false);
            assert_eq!(drain("secret").await.unwrap().status(), 202);
        }
        until("it drains", async || server.status().await["draining"] == true).await;
        assert_eq!(http::get(&server.url("/load")).await.text(), "100");
        let mut late = Client::start(&server, &arm()).await;
        let told = late.until("loading: Error:").await;
        assert!(
            told.contains("about to end, and takes no new clients. Connect again"),
            "{told}"
        );
        assert_eq!(late.closed().await, Some(1013), "another server may take it");
        // The simulation goes on, also for new viewers.
        let _viewer = Client::connect(&format!("{stream}/")).await.with_scene().await;
        running.leave().await;
        waiting.until("webots:").await;
        assert_eq!(stages(&server).await, ["idle"], "who was in the line is served");
        waiting.leave().await;
        assert_eq!(server.ended().await, Some(0));
    }
}

#[actix_rt::test]
async fn drain_is_off_without_a_password_and_ends_an_empty_server() {
    let mut server = demo_server(1).start().await;
    assert_eq!(
        awc::Client::new()
            .post(server.url("/drain"))
            .send()
            .await
            .unwrap()
            .status(),
        403
    );
    server.signal(Signal::SIGHUP);
    until("it is logged", async || {
        server.log().contains("the key ready was read again")
    })
    .await;
    server.signal(Signal::SIGUSR1);
    assert_eq!(server.ended().await, Some(0));
}

#[actix_rt::test]
async fn a_fault_of_the_configuration_is_one_line_and_exit_code_2() {
    for (key, value, words) in [
        (
            "allowedOrigins",
            json!("https://lab.org/viewer"),
            ["allowedOrigins", "no origin; allowed is \"https://lab.org\""],
        ),
        (
            "allowedRepositories",
            json!(["github.com/lab"]),
            ["allowedRepositories", "\"github.com/lab\" is no URL prefix: it"],
        ),
        (
            "blockedRepositories",
            json!("https://x/a%2fb"),
            ["blockedRepositories", "allowed are such as https://git"],
        ),
        (
            "gitMirrors",
            json!({"x": "file:/y"}),
            ["gitMirrors", "\"x\" is no URL prefix"],
        ),
        ("timeout", json!(359), ["timeout", "360"]),
        (
            "maxConnections",
            json!(0),
            ["maxConnections", "a whole number from 1 to 10000"],
        ),
        ("shareIdleTime", json!(101), ["shareIdleTime", "101"]),
        ("timing", json!({"checkout": -1}), ["timing.checkout", "-1"]),
        (
            "gitMirrors",
            json!([["https://a.forge", "file:b"]]),
            [" gitMirrors: ", ""],
        ),
        (
            "timing",
            json!({"silence": 20}),
            ["timing.silence", "not more than timing.ping"],
        ),
        ("isolation", json!("jail"), ["isolation: unknown variant `jail`", ""]),
        (
            "sandbox",
            json!({"readable": "/"}),
            ["sandbox.readable: \"/\" can't be shown", ""],
        ),
        (
            "sandbox",
            json!({"writable": ["/srv", "/proc/self/.."]}),
            ["sandbox.writable: \"/proc/self/..\"", ""],
        ),
        ("sandbox", json!({"network": "open"}), ["unknown variant `open`", ""]),
        ("container", json!({"network": "open"}), ["unknown variant `open`", ""]),
        ("container", json!({"netwrok": "closed"}), ["netwrok", ""]),
    ] {
        refused(demo_server(1).set(key, value), &words).await;
    }
    let containers = || demo_server(1).set("isolation", "container");
    let own_network = |isolation| demo_server(1).set("isolation", isolation).set("sandbox.network", "own");
    for (builder, words) in [
        (
            containers().set("isolation", "sandbox").set("docker", true),
            "docker: true asks for containers, but isolation",
        ),
        (own_network("none"), "sandbox.network: networks of simulations' own"),
        (
            own_network("container"),
            "sandbox.network: networks of simulations' own",
        ),
        (containers().set("maxConnections", 501), "allowed are up to 500 places"),
        (
            containers().set("port", 64_990).set("maxConnections", 100),
            "editors up to port 65535",
        ),
    ] {
        refused(builder, &[words]).await;
    }
}

/// Starts a server, which must refuse its configuration with these words.
async fn refused(builder: Builder, words: &[&str]) {
    let said = builder.refused(2).await;
    assert!(
        said.contains("config.json: ") && words.iter().all(|word| said.contains(word)),
        "{words:?}: {said}"
    );
}

#[actix_rt::test]
async fn the_server_announces_itself_and_waits_for_nobody() {
    // Each request gets the next answer.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}/announce", listener.local_addr().unwrap());
    let (sender, requests) = std::sync::mpsc::channel();
    let mut answers = [(500, ""), (200, r#"{"success": true}"#)].into_iter();
    // webots.cloud refuses like this.
    let refusing = TcpListener::bind("127.0.0.1:0").unwrap();
    let refusing_url = format!("http://{}/", refusing.local_addr().unwrap());
    listen(refusing, |_| Some((200, r#"{"error": "unknown server"}"#)));
    listen(listener, move |request| {
        let answer = answers.next()?;
        sender.send(request).ok()?;
        Some(answer)
    });
    let hanging = TcpListener::bind("127.0.0.1:0").unwrap();
    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let notify = json!([
        url,
        format!("http://{}/", hanging.local_addr().unwrap()),
        format!("http://{closed}/"),
        refusing_url
    ]);
    let allowed = json!(["https://github.com/lab", "https://github.com/other/x"]);
    let builder = demo_server(1).set("notify", notify);
    let begin = Instant::now();
    let server = builder
        .set("timing.announce", 0.05)
        .set("allowedRepositories", allowed)
        .set("shareIdleTime", 25)
        .start()
        .await;
    assert!(
        begin.elapsed() < Duration::from_secs(5),
        "the start waited for an announcement"
    );
    let body = format!(
        "url=http%3A%2F%2Flocalhost%3A{}&shareIdleTime=0&allowedRepositories=https%3A%2F%2Fgithub.com%2Flab%2Chttps%3A%2F%2Fgithub.com%2Fother%2Fx",
        server.port
    );
    for _ in 0..2 {
        let Request { head, content } = requests.recv_timeout(SOON).unwrap();
        assert!(head.starts_with("POST /announce HTTP/1.1\r\n"), "{head}");
        assert!(
            head.to_lowercase()
                .contains("content-type: application/x-www-form-urlencoded"),
            "{head}"
        );
        assert_eq!(String::from_utf8(content).unwrap(), body);
    }
    let refused = format!("{refusing_url} refuses this server: \"{{\\\"error\\\": \\\"unknown server\\\"}}\"");
    until("a refusal is a warning", async || server.log().contains(&refused)).await;
    let answered = format!("announced to {url}, which answered \"{{\\\"success\\\": true}}\"");
    until("it was told", async || server.log().contains(&answered)).await;
    assert!(
        server
            .log()
            .contains(&format!("can't announce to {url} (1 of 6): it answered 500"))
    );
    until("it gave up", async || {
        server
            .log()
            .contains(&format!("gave up announcing to http://{closed}/"))
    })
    .await;
    assert_eq!(
        server
            .log()
            .matches(&format!("can't announce to http://{closed}/"))
            .count(),
        6
    );
    let _client = Client::ready(&server).await;
}
