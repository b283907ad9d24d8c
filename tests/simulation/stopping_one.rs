//! An administrator stops one simulation: its client receives the reason, and no other simulation ends.

use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::ends::line;
use super::scene::{ALL, Scene, nothing_left};
use crate::support::http::{self, PASSWORD, post};
use crate::support::{Builder, Client, SOON, Server, demo_server};

const TOLD: &str = "loading: Error: The administrator has stopped this simulation";

fn with_password(builder: Builder) -> Builder {
    builder.set("adminPassword", PASSWORD)
}

fn path(server: &Server, id: &str) -> String {
    server.url(&format!("/simulations/{id}/stop"))
}

async fn stop(server: &Server, id: &str, body: &str) -> u16 {
    post(&path(server, id), Some(PASSWORD), body).await
}

#[actix_rt::test]
async fn a_simulation_is_stopped_in_any_state() {
    for state in &ALL[1..6] {
        let mut scene = Scene::new(state, with_password).await;
        let server = &scene.server;
        let client = scene.client.as_mut().unwrap();
        let id = client.id().to_owned();
        assert_eq!(
            stop(server, &id, r#"{"reason": "<b>Back to work"}"#).await,
            202,
            "{state:?}"
        );
        let told = client.until("loading: Error:").await;
        assert_eq!(told, format!("{TOLD}: \u{2039}b\u{203a}Back to work"), "{state:?}");
        assert_eq!(client.closed().await, Some(1000), "{state:?}");
        assert_eq!(line(server, &id).await[10], "stopped-by-administrator", "{state:?}");
        assert_eq!(stop(server, &id, "").await, 404, "{state:?}");
        if let Some(other) = &mut scene.other {
            other.until(".").await;
        } else {
            nothing_left(server, 1).await;
        }
        let metrics = server.metrics().await;
        assert!(
            metrics.contains("webots_simulation_ends_total{reason=\"stopped-by-administrator\"} 1"),
            "{metrics}"
        );
        let page = server.monitor().await;
        assert!(page.contains("The administrator has stopped it"), "{state:?}");
        assert!(
            !page.contains("to work"),
            "what a student was told is not for everybody"
        );
    }
}

#[actix_rt::test]
async fn only_the_password_stops_a_simulation() {
    let server = with_password(demo_server(2)).start().await;
    let mut client = Client::ready(&server).await;
    let url = path(&server, client.id());
    assert_eq!(post(&url, None, "").await, 401);
    assert_eq!(post(&url, Some("guess"), "").await, 401);
    let foreign = awc::Client::default().post(&url).basic_auth("admin", PASSWORD);
    let answer = foreign
        .insert_header(("Origin", "https://evil.example"))
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), 403);
    assert_eq!(http::get(&url).await.status.as_u16(), 405);
    for body in ["{", "5", r#"{"reason": 5}"#, r#"{"why": "x"}"#, "please"] {
        assert_eq!(stop(&server, client.id(), body).await, 400, "{body}");
    }
    assert_eq!(
        stop(
            &server,
            client.id(),
            &format!(r#"{{"reason": "{}"}}"#, "x".repeat(9000))
        )
        .await,
        413
    );
    client.until(".").await;
    // Without a reason, and with one that is too long.
    let mut other = Client::ready(&server).await;
    assert_eq!(stop(&server, client.id(), "").await, 202);
    assert_eq!(client.until("loading: Error:").await, TOLD);
    assert_eq!(
        stop(&server, other.id(), &json!({"reason": "x\n".repeat(200)}).to_string()).await,
        202
    );
    let told = other.until("loading: Error:").await;
    assert!(told.len() < 400 && told.ends_with("..."), "{told}");
    // Without an `adminPassword`, a server allows no actions.
    let server = demo_server(1).start().await;
    let mut client = Client::ready(&server).await;
    assert_eq!(post(&path(&server, client.id()), Some(PASSWORD), "").await, 403);
    client.until(".").await;
}

#[actix_rt::test]
async fn the_sentence_of_a_stop_is_a_key() {
    let server = with_password(demo_server(1))
        .set("stopText", " The lab has stopped <it> ")
        .start()
        .await;
    let mut client = Client::ready(&server).await;
    assert_eq!(stop(&server, client.id(), r#"{"reason": "Lunch"}"#).await, 202);
    let told = client.until("loading: Error:").await;
    assert_eq!(told, "loading: Error: The lab has stopped \u{2039}it\u{203a}: Lunch");
    for wrong in ["", " ", "two\nlines", &"x".repeat(201)] {
        let said = demo_server(1).set("stopText", wrong).refused(2).await;
        assert!(said.contains("stopText"), "{said}");
    }
}

/// Sends these bytes on one connection, waits for `count` answers, and returns their statuses.
async fn statuses(server: &Server, requests: &[String], count: usize) -> Vec<u16> {
    let mut socket = TcpStream::connect(server.address()).await.unwrap();
    let mut answers = Vec::new();
    let statuses = |answers: &[u8]| -> Vec<u16> {
        let text = String::from_utf8_lossy(answers);
        text.split("HTTP/1.1 ")
            .skip(1)
            .map(|answer| answer[..3].parse().unwrap())
            .collect()
    };
    for request in requests {
        socket.write_all(request.as_bytes()).await.unwrap();
    }
    let read = async { while statuses(&answers).len() < count && socket.read_buf(&mut answers).await.unwrap() > 0 {} };
    actix_rt::time::timeout(SOON, read).await.expect("all answers");
    statuses(&answers)
}

#[actix_rt::test]
async fn a_body_belongs_to_its_request_and_holds_up_nobody() {
    let server = with_password(demo_server(1)).start().await;
    let post = |password: bool, more: &str, body: &str| {
        let password = if password {
            "Authorization: Basic YWRtaW46b3BlbiBzZXNhbWU=\r\n"
        } else {
            ""
        };
        format!("POST /simulations/1-1/stop HTTP/1.1\r\nHost: x\r\n{password}{more}\r\n{body}")
    };
    let load = || "GET /load HTTP/1.1\r\nHost: x\r\n\r\n".to_owned();
    let length = |body: &str| format!("Content-Length: {}\r\n", body.len());
    // The body of a request that looks like a request itself.
    let inner = "GET /health HTTP/1.1\r\nHost: x\r\n\r\n";
    let body = r#"{"reason": "x"}"#;
    for (requests, expected) in [
        (vec![post(true, &length(body), body), load()], vec![404, 200]),
        (vec![post(true, "", ""), load()], vec![404, 200]),
        (vec![post(true, &length(inner), inner), load()], vec![400, 200]),
        (vec![post(true, "Transfer-Encoding: chunked\r\n", "5\r\n")], vec![413]),
        (vec![post(true, "Content-Length: 9000\r\n", "x")], vec![413]),
        (vec![post(true, "Content-Length: 99\r\n", "{")], vec![408]),
        (
            vec![post(true, "Content-Length: 18446744073709551616\r\n", "x")],
            vec![400],
        ),
    ] {
        assert_eq!(
            statuses(&server, &requests, expected.len()).await,
            expected,
            "{requests:?}"
        );
    }
    // Without the password, the server does not wait for the body.
    assert_eq!(
        statuses(&server, &[post(false, "Content-Length: 99\r\n", "{")], 1).await,
        [401]
    );
    assert_eq!(
        statuses(&server, &[post(false, &length(body), body), load()], 2).await[0],
        401
    );
}

#[actix_rt::test]
async fn a_stop_never_ends_the_next_simulation_of_a_slot() {
    let folder = tempfile::tempdir().unwrap();
    let builder = || with_password(demo_server(1)).folder(folder.path());
    let server = builder().start().await;
    let mut ids = Vec::new();
    for _ in 0..3 {
        let client = Client::ready(&server).await;
        ids.push(client.id().to_owned());
        client.close_with(1000).await;
        nothing_left(&server, 1).await;
    }
    drop(server);
    // A new run of the server numbers from the beginning again, and uses the same slot.
    let server = builder().start().await;
    let mut client = Client::ready(&server).await;
    let id = client.id().to_owned();
    let number = id.split_once('-').unwrap().1;
    assert!(
        ids[0].ends_with(&format!("-{number}")) && !ids.contains(&id),
        "{ids:?} {id}"
    );
    let like = [
        &id[1..],
        &format!("{id}0"),
        &format!("%20{id}"),
        number,
        "..",
        &format!("x-{number}"),
    ];
    for other in ids.iter().map(String::as_str).chain(like) {
        let status = stop(&server, other, "").await;
        assert!([404, 405].contains(&status), "{other}: {status}");
    }
    client.until(".").await;
    assert_eq!(server.status().await["simulations"][0]["id"], id.as_str());
}

#[actix_rt::test]
async fn a_client_that_is_away_hears_of_the_stop_when_it_comes_back() {
    let server = with_password(demo_server(1)).start().await;
    let (client, token) = Client::resumable(&server).await;
    let id = client.id().to_owned();
    drop(client);
    server.until_away(1).await;
    assert_eq!(stop(&server, &id, r#"{"reason": "That is enough"}"#).await, 202);
    nothing_left(&server, 1).await;
    let mut back = Client::resuming(&server, &token).await;
    let told = "this simulation has ended: The administrator has stopped this simulation: That is enough";
    assert_eq!(back.until("").await, format!("loading: Error: {told}"));
    assert_eq!(back.closed().await, Some(1000));
}
