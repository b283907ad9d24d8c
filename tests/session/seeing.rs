//! What administrators and other programs see: pages, headers, logs, configuration errors.

use serde_json::json;

use super::stand_in::{Manner, StandIn};
use super::{addresses, times_logged, until_states};
use crate::support::program::session_server;
use crate::support::{http, until};

#[actix_rt::test]
async fn pages_of_other_origins_may_ask_and_nothing_is_posted_there() {
    use awc::http::{Method, StatusCode};
    let session = session_server(&[]).start().await;
    let ask = async |method: Method, path: &str| {
        let answer = awc::Client::default()
            .request(method, session.url(path))
            .send()
            .await
            .unwrap();
        let header = |name| {
            answer
                .headers()
                .get(name)
                .and_then(|value| value.to_str().ok())
                .unwrap_or_default()
        };
        assert_eq!(header("access-control-allow-origin"), "*", "{path}");
        assert_eq!(header("access-control-allow-headers"), "x-requested-with", "{path}");
        assert_eq!(header("access-control-allow-methods"), "POST, GET, OPTIONS", "{path}");
        (answer.status(), header("allow").to_owned())
    };
    for path in ["/request", "/session", "/load", "/status", "/monitor"] {
        assert_eq!(ask(Method::GET, path).await.0, 200, "{path}");
        assert!(ask(Method::OPTIONS, path).await.0.is_success(), "{path}");
        let (status, allow) = ask(Method::POST, path).await;
        assert!(
            status == StatusCode::METHOD_NOT_ALLOWED && allow.starts_with("GET"),
            "{path}: {status} {allow}"
        );
    }
    for path in ["/health", "/status", "/monitor"] {
        assert_eq!(ask(Method::HEAD, path).await.0, 200, "{path}");
    }
    assert_eq!(ask(Method::GET, "/nothing").await.0, 404);
    assert!(http::get(&session.url("/nothing")).await.text().starts_with("Error: "));
}

#[actix_rt::test]
async fn status_and_metrics_have_what_an_alarm_needs() {
    let lab = json!({"load": 20, "version": "9", "docker": false, "allowedRepositories": ["https://github.com/lab"],
        "instances": {"queued": 0, "starting": 1, "idle": 2, "running": 3, "places": 9, "arrivals": 6}});
    let servers = [
        Manner::Status(lab),
        Manner::Body(500, Vec::new()),
        Manner::Load("40".into()),
    ]
    .map(StandIn::start);
    let builder = session_server(&addresses(&servers))
        .set("loadRefresh", 600)
        .set("clientCost", 3);
    let session = builder
        .set("drainedServers", json!([servers[2].address()]))
        .start()
        .await;
    until_states(&session, &["up", "down", "draining"]).await;
    assert_eq!(
        http::get(&session.url("/load")).await.text(),
        "30",
        "the mean of all who answer"
    );
    assert_eq!(http::get(&session.url("/session")).await.text(), servers[0].url());
    http::get(&session.url("/session?url=nonsense")).await;

    let status = session.status().await;
    assert_eq!(
        (&status["version"], &status["available"]),
        (&json!(env!("CARGO_PKG_VERSION")), &json!(true))
    );
    assert_eq!((&status["clients"], &status["load"]), (&json!(0), &json!(30.0)));
    assert!(status["uptime"].is_u64());
    let up = &status["servers"][0];
    let down = &status["servers"][1];
    assert_eq!(up["address"], servers[0].address());
    assert_eq!(
        (&up["load"], &up["effectiveLoad"], &up["inFlight"]),
        (&json!(20.0), &json!(23.0), &json!(1))
    );
    assert_eq!(
        (&up["instances"]["running"], &up["instances"]["places"]),
        (&json!(3), &json!(9))
    );
    assert_eq!(up["allowedRepositories"], json!(["https://github.com/lab"]));
    assert!(up["age"].as_f64().unwrap() < 20.0 && up["latency"].as_f64().unwrap() < 3.0);
    assert_eq!(
        (&down["state"], &down["load"], &down["age"]),
        (&json!("down"), &json!(null), &json!(null))
    );
    assert!(down["error"].as_str().unwrap().contains("500"));
    assert_eq!(
        (&up["reason"], &down["reason"]),
        (&json!(null), &json!("invalid-answer"))
    );
    assert_eq!(status["changes"].as_array().unwrap().len(), 3);
    let page = http::get(&session.url("/monitor")).await;
    assert!(page.header("content-type").unwrap().starts_with("text/html"));
    for server in &servers {
        assert!(page.text().contains(&server.address()));
    }

    let answer = http::get(&session.url("/metrics")).await;
    assert!(answer.header("content-type").unwrap().starts_with("text/plain"));
    let text = answer.text();
    let up = servers[0].address();
    let down = servers[1].address();
    for line in [
        "available 1".to_owned(),
        "load_percent 30".to_owned(),
        "requests_total{outcome=\"placed\"} 1".to_owned(),
        "requests_total{outcome=\"invalid-world\"} 1".to_owned(),
        "requests_total{outcome=\"repository-not-allowed\"} 0".to_owned(),
        "servers{state=\"up\"} 1".to_owned(),
        format!("server_up{{server=\"{up}\"}} 1"),
        format!("server_up{{server=\"{down}\"}} 0"),
        format!("server_load_percent{{server=\"{up}\"}} 20"),
        format!("server_effective_load_percent{{server=\"{up}\"}} 23"),
        format!("server_in_flight{{server=\"{up}\"}} 1"),
    ] {
        let line = format!("webots_session_{line}");
        assert!(text.lines().any(|found| found == line), "no {line:?} in {text}");
    }
    assert!(
        text.contains(&format!("webots_session_server_latency_seconds{{server=\"{up}\"}}")),
        "{text}"
    );
    assert!(
        !text.contains(&format!("webots_session_server_load_percent{{server=\"{down}\"}}")),
        "{text}"
    );
    assert_eq!(http::get(&session.url("/health")).await.text(), "ok");
}

#[actix_rt::test]
async fn port_0_takes_a_free_port_and_says_which() {
    let session = session_server(&[]).set("port", 0).set("portRewrite", true).spawn();
    let line = async || {
        session
            .log()
            .lines()
            .find(|line| line.starts_with("session server "))
            .map(str::to_owned)
    };
    until("it says where it is", async || line().await.is_some()).await;
    let line = line().await.unwrap();
    let port = line
        .split_once("http://localhost/")
        .and_then(|(_, rest)| rest.split_once("/monitor"))
        .unwrap()
        .0;
    assert!(line.ends_with(&format!(" ws://localhost/{port}/session")), "{line}");
    assert_eq!(http::get(&format!("http://127.0.0.1:{port}/health")).await.status, 200);
    assert_eq!(
        times_logged(&session, &format!("listens on port {port}: http://localhost/{port}")),
        1
    );
}

#[actix_rt::test]
async fn a_fault_of_the_configuration_is_one_line_and_exit_code_2() {
    for (key, value, words) in [
        ("port", json!(65536), ["port", "65535"]),
        (
            "simulationServers",
            json!("localhost:2000"),
            ["simulationServers", "sequence"],
        ),
        (
            "simulationServers",
            json!(["dns+a"]),
            ["simulationServers[0]", "dns+NAME:PORT"],
        ),
        (
            "simulationServers",
            json!(["dnssrv+a.b"]),
            ["simulationServers", "dns+NAME:PORT"],
        ),
        ("drainedServers", json!(["a:1"]), ["drainedServers", "a:1"]),
        ("loadThreshold", json!(-1), ["loadThreshold", "-1"]),
        ("loadRefresh", json!(0), ["loadRefresh", "0"]),
        (
            "timing",
            json!({"answer": "fast"}),
            ["timing.answer", "a number of seconds"],
        ),
        ("timing", json!({"anser": 1}), ["timing", "anser"]),
        (
            "timing",
            json!({"ping": 10, "silence": 10}),
            ["timing.silence", "timing.ping"],
        ),
        ("examples", json!({"titel": "a", "url": "b"}), ["examples", "title"]),
    ] {
        let said = session_server(&[]).set(key, value.clone()).refused(2).await;
        assert!(said.contains("config.json: "), "{said}");
        assert!(
            words.iter().all(|word| said.contains(word)),
            "{key}: {value} gives {said}"
        );
    }
}

#[actix_rt::test]
async fn texts_of_a_server_are_data_on_the_page_and_in_the_log() {
    let evil = "<script>alert(1)</script>\r\n2026-01-01T00:00:00Z [ERROR] forged";
    let hidden = "1\u{202e}gpj\u{200b}.exe\u{2028}";
    let repository = "https://github.com/lab\u{202e}bal";
    let status = json!({"load": 1, "version": hidden, "allowedRepositories": [repository]});
    let bodies = [format!("{hidden}\n"), evil.to_owned()].map(|text| Manner::Body(200, text.into_bytes()));
    let servers: Vec<_> = [Manner::Status(status)]
        .into_iter()
        .chain(bodies)
        .map(StandIn::start)
        .collect();
    let session = session_server(&addresses(&servers)).start().await;
    until_states(&session, &["up", "down", "down"]).await;
    let page = session.monitor().await;
    assert!(!page.contains("<script>alert"), "{page}");
    assert!(
        session
            .log()
            .lines()
            .all(|line| !line.starts_with("2026-01-01T00:00:00Z [ERROR]"))
    );
    assert!(
        page.contains("1\u{fffd}gpj\u{fffd}.exe") && page.contains("lab\u{fffd}bal"),
        "{page}"
    );
    for text in [page, session.log()] {
        assert!(!text.contains(['\u{202e}', '\u{200b}', '\u{2028}']), "{text}");
    }
}
