//! Requests by which a client could hold a connection or cost much, on both servers.

use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::support::http::{PASSWORD, get_as_administrator};
use crate::support::program::{Server, demo_server, session_server};
use crate::support::{SOON, http, until};

/// Sends these bytes, and returns what is received until the server closes the connection. It reads while it sends,
/// because a server that can't send its answers stops to read requests.
async fn raw(server: &Server, bytes: &[u8]) -> String {
    raw_within(SOON, server, bytes).await
}

/// The same, for requests that take a busy machine longer.
async fn raw_within(limit: Duration, server: &Server, bytes: &[u8]) -> String {
    let mut socket = TcpStream::connect(server.address()).await.unwrap();
    let (mut reader, mut writer) = socket.split();
    let mut answer = Vec::new();
    let both = async { tokio::join!(writer.write_all(bytes), reader.read_to_end(&mut answer)) };
    let (sent, received) = actix_rt::time::timeout(limit, both).await.unwrap_or_else(|_| {
        let beginning = String::from_utf8_lossy(&bytes[..bytes.len().min(200)]);
        panic!("the connection is kept after {beginning}")
    });
    sent.unwrap();
    received.ok();
    String::from_utf8_lossy(&answer).into_owned()
}

#[actix_rt::test]
async fn a_body_without_a_length_holds_no_connection() {
    for server in [session_server(&[]).start().await, demo_server(1).start().await] {
        for (request, status) in [
            ("GET /load", 200),
            ("HEAD /load", 200),
            ("GET /monitor", 200),
            ("GET /nothing", 404),
            ("POST /load", 405),
            ("OPTIONS /load", 204),
        ] {
            let request = format!("{request} HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n");
            // Without the body, with a part of it, and with another request behind it.
            for rest in ["", "5\r\nab", "0\r\n\r\nGET /load HTTP/1.1\r\nHost: x\r\n\r\n"] {
                let answer = raw(&server, format!("{request}{rest}").as_bytes()).await;
                assert!(
                    answer.starts_with(&format!("HTTP/1.1 {status} ")),
                    "{request}: {answer}"
                );
                assert_eq!(answer.matches("HTTP/1.1 ").count(), 1, "{request}: {answer}");
            }
        }
    }
}

#[actix_rt::test]
async fn other_beginnings_of_a_request_are_answered_at_once() {
    let server = session_server(&[]).start().await;
    for (bytes, status) in [
        // A client that speaks TLS.
        (&b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"[..], 400),
        (
            b"\r\n\n\r\nGET /load HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
            200,
        ),
        (b"GET /load HTTP/1.1\nHost: x\nConnection: close\n\n", 200),
        (b"GET /load HTTP/1.1\nHost: x\r\nConnection: close\n\r\n", 200),
    ] {
        let answer = raw(&server, bytes).await;
        assert!(
            answer.starts_with(&format!("HTTP/1.1 {status} ")),
            "{bytes:?}: {answer}"
        );
    }
}

#[actix_rt::test]
async fn guesses_from_many_addresses_lock_no_administrator_out() {
    let server = demo_server(1).set("adminPassword", PASSWORD).start().await;
    let guess = BASE64_STANDARD.encode("admin:guess");
    let requests: String = (0..10_300)
        .map(|number| {
            format!(
                "HEAD /status HTTP/1.1\r\nHost: x\r\nX-Forwarded-For: 2001:db8:{number:x}::1\r\nAuthorization: Basic {guess}\r\n\r\n"
            )
        })
        .collect();
    let last = "GET /health HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n";
    let answers = raw_within(6 * SOON, &server, format!("{requests}{last}").as_bytes()).await;
    let answered = answers.matches("HTTP/1.1 200 ").count();
    let end = &answers[answers.len().saturating_sub(500)..];
    assert_eq!(answered, 10_301, "…{end}");
    let answer = get_as_administrator(&server.url("/sign-in")).await;
    assert_eq!(answer.status.as_u16(), 303, "{}", answer.text());
}

#[actix_rt::test]
async fn a_monitor_that_has_not_changed_is_not_sent_again() {
    for server in [session_server(&[]).start().await, demo_server(1).start().await] {
        let url = server.url("/monitor");
        until("the browser's page is still the current one", async || {
            let page = http::get(&url).await;
            assert_eq!(page.header("cache-control"), Some("private, no-cache"));
            let tag = page.header("etag").unwrap().to_owned();
            let again = awc::Client::new()
                .get(&url)
                .insert_header(("if-none-match", tag.as_str()));
            again.send().await.unwrap().status() == 304
        })
        .await;
        let other = awc::Client::new().get(&url).insert_header(("if-none-match", "\"x\""));
        assert_eq!(other.send().await.unwrap().status(), 200);
    }
}

#[actix_rt::test]
async fn a_monitor_that_is_requested_in_a_row_is_rendered_ten_times_a_second() {
    for server in [session_server(&[]).start().await, demo_server(1).start().await] {
        let url = server.url("/monitor");
        http::get(&url).await;
        let begin = Instant::now();
        for _ in 0..10 {
            http::get(&url).await;
        }
        assert!(begin.elapsed() > Duration::from_millis(950), "{:?}", begin.elapsed());
        // Many visitors share a rendering.
        let begin = Instant::now();
        let all = futures_util::future::join_all((0..100).map(|_| http::get(&url))).await;
        assert!(all.iter().all(|page| page.status == 200));
        assert!(begin.elapsed() < Duration::from_secs(5), "{:?}", begin.elapsed());
    }
}

#[actix_rt::test]
async fn a_log_that_nobody_reads_stops_no_server() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe");
    let pipe = pipe.display();
    // The server holds both ends of the pipe.
    let unread = session_server(&[])
        .env("RUST_LOG", "trace")
        .before(&format!("mkfifo '{pipe}' && exec 3<>'{pipe}' >'{pipe}'"));
    let server = unread.start().await;
    for _ in 0..500 {
        assert_eq!(http::get(&server.url("/health")).await.status, 200);
    }
    // Whoever reads again learns how much is missing.
    let reader = tokio::net::unix::pipe::OpenOptions::new()
        .open_receiver(folder.path().join("pipe"))
        .unwrap();
    let mut log = String::new();
    let mut buffer = vec![0; 64 << 10];
    until("the log tells that lines are missing", async || {
        http::get(&server.url("/health")).await;
        while let Ok(length) = reader.try_read(&mut buffer) {
            log += &String::from_utf8_lossy(&buffer[..length]);
        }
        log.contains(" lines are missing here, because nobody read standard output\n")
    })
    .await;
}
