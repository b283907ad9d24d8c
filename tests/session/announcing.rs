//! The administrator's announcements: which clients receive them, and which are unaffected.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::support::client::Client;
use crate::support::http::{PASSWORD, post};
use crate::support::program::{Server, session_server};

const ASKS: &str = "/session?announcements=1";

async fn announce(session: &Server, order: &Value) -> u16 {
    post(&session.url("/announcement"), Some(PASSWORD), &order.to_string()).await
}

#[actix_rt::test]
async fn an_announcement_reaches_who_asks_for_it_in_time() {
    let session = session_server(&[]).set("adminPassword", PASSWORD).start().await;
    let mut viewer = Client::connect(&session.websocket(ASKS)).await;
    let mut old = Vec::new();
    for path in ["/", "/session", "/session?announcements=0"] {
        old.push(Client::connect(&session.websocket(path)).await);
    }
    viewer.until("0").await;
    let text = "<b>Maintenance</b> & more\nat noon";
    let asked = Instant::now();
    assert_eq!(announce(&session, &json!({"text": text})).await, 200);
    let told = viewer.until("announcement:").await;
    assert_eq!(
        told,
        "announcement: \u{2039}b\u{203a}Maintenance\u{2039}/b\u{203a} \u{ff06} more at noon"
    );
    let shown = "Maintenance&#60;/b&#62; &#38; more at noon";
    let page = session.monitor().await;
    assert!(page.contains(shown) && !page.contains("<b>Maint"), "{page}");
    assert!(asked.elapsed() < Duration::from_secs(2), "{:?}", asked.elapsed());
    // Clients that connect later receive it too.
    Client::connect(&session.websocket(ASKS))
        .await
        .until("announcement: ")
        .await;
    // Another announcement, and its end.
    assert_eq!(announce(&session, &json!({"text": "R&D"})).await, 200);
    assert_eq!(viewer.until("announcement:").await, "announcement: R\u{ff06}D");
    assert!(!session.monitor().await.contains("Maintenance"));
    assert_eq!(post(&session.url("/announcement"), Some(PASSWORD), "").await, 200);
    assert_eq!(viewer.until("announcement:").await, "announcement:");
    // Pages that don't ask for announcements received none, nor do clients that connect after the end.
    old.push(Client::connect(&session.websocket(ASKS)).await);
    for client in &mut old {
        client.send("").await;
        client.until("Error:").await;
        assert_eq!(client.heard[0], "0");
        assert_eq!(client.heard.len(), 2, "{:?}", client.heard);
    }
}

#[actix_rt::test]
async fn only_the_password_announces_something() {
    let session = session_server(&[]).set("adminPassword", PASSWORD).start().await;
    let url = session.url("/announcement");
    let order = r#"{"text": "hello"}"#;
    assert_eq!(post(&url, None, order).await, 401);
    assert_eq!(post(&url, Some("guess"), order).await, 401);
    let foreign = awc::Client::default().post(&url).basic_auth("admin", PASSWORD);
    let answer = foreign
        .insert_header(("Origin", "https://evil.example"))
        .send_body(order)
        .await
        .unwrap();
    assert_eq!(answer.status(), 403);
    for wrong in [
        json!({"text": 5}),
        json!({"text": "x", "more": 1}),
        json!({"text": "x".repeat(301)}),
    ] {
        assert_eq!(announce(&session, &wrong).await, 400, "{wrong}");
    }
    assert!(!session.monitor().await.contains("class=\"announcement\""));
    let session = session_server(&[]).start().await;
    assert_eq!(post(&session.url("/announcement"), Some(PASSWORD), order).await, 403);
}
