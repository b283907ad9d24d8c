//! Users who sign in at the web server: a stand-in for oauth2-proxy, a real nginx, and what the simulation server shows.

use std::net::TcpListener;

use super::fleet::{Fleet, arm};
use super::rules::Rules;
use crate::support::client::Client;
use crate::support::http::PASSWORD;
use crate::support::listener::serve;

/// A stand-in for oauth2-proxy: the cookie holds the name of the signed-in user.
pub fn oauth2_proxy() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    serve(listener, None, |request| {
        let answer = match (request.path(), request.header("cookie").strip_prefix("_oauth2_proxy=")) {
            ("/oauth2/auth", Some(name)) => format!("202 Accepted\r\nX-Auth-Request-Email: {name}@lab.example"),
            ("/oauth2/auth", None) => "401 Unauthorized".to_owned(),
            _ => "200 OK".to_owned(),
        };
        Some((answer, Vec::new()))
    });
    port
}

#[actix_rt::test]
async fn who_signs_in_at_the_web_server_is_known_to_the_administrator() {
    let rules = Rules::NginxWithUsers(oauth2_proxy());
    let keys = |builder: crate::support::program::Builder| builder.set("adminPassword", PASSWORD);
    // The session server does not sign in, and still reaches its servers.
    let fleet = Fleet::start_with(rules, |builder| keys(builder).set("userHeader", "X-Forwarded-User")).await;
    let visitor = fleet.browser.at("127.0.0.9");
    let client = format!("{}/client", fleet.wss(&fleet.here));
    let page = visitor.get("/viewer").await;
    assert_eq!(page.status.as_u16(), 302);
    assert!(
        page.header("location").unwrap().ends_with("/oauth2/sign_in?rd=/viewer"),
        "{page:?}"
    );
    assert!(visitor.try_open(&client, &[]).await.is_err());
    assert_eq!(visitor.get("/oauth2/sign_in").await.status.as_u16(), 200);
    assert_eq!(
        visitor.get("/oauth2/auth").await.status.as_u16(),
        404,
        "nobody asks for others"
    );

    // Frames without an origin need assets and streams, so these are public; no path leads from there to other pages.
    let port = fleet.here.port;
    for (path, status) in [
        ("/assets/style.css".to_owned(), 200),
        (format!("/{port}/assets/style.css"), 200),
        (format!("/{port}/wwi/WebotsView.js"), 404),
        (format!("/{port}/stream/{}/", "0".repeat(32)), 404),
        (format!("/{port}/assets/../monitor"), 302),
        (format!("/{port}/assets/%2e%2e/monitor"), 302),
        ("/assets/../monitor".to_owned(), 302),
        (format!("/monitor?/{port}/assets/"), 302),
        (format!("/{port}/status?/{port}/stream/"), 302),
        (format!("/{port}/status/{port}/stream/"), 302),
        (format!("/{}/stream/x", port + 1), 404),
        (format!("/{}/{port}/stream/x", port + 1), 302),
    ] {
        let answer = visitor.get(&path).await;
        assert_eq!(answer.status.as_u16(), status, "{path}: {answer:?}");
    }

    let anna = [("cookie", "_oauth2_proxy=anna")];
    assert_eq!(
        visitor
            .ask(&format!("https://{}/viewer", visitor.host), &anna)
            .await
            .status
            .as_u16(),
        200
    );
    let mut running: Vec<Client> = Vec::new();
    // A `userHeader` sent by the visitor is ignored.
    for headers in [
        vec![anna[0]],
        vec![("cookie", "_oauth2_proxy=ben"), ("x-forwarded-user", "intruder")],
    ] {
        let mut client = visitor.try_open(&client, &headers).await.unwrap();
        client
            .send(&serde_json::json!({"start": {"url": arm(), "name": "somebody"}}).to_string())
            .await;
        client.until("webots:").await;
        running.push(client);
    }
    let monitor = format!("https://{}/{}/monitor", visitor.host, fleet.here.port);
    let page = visitor.ask(&monitor, &anna).await.text();
    assert!(!page.contains("lab.example") && !page.contains("somebody"), "{page}");
    let password = ("authorization", "Basic YWRtaW46b3BlbiBzZXNhbWU=");
    let page = visitor.ask(&monitor, &[anna[0], password]).await.text();
    for name in ["<b>anna@lab.example</b>", "<b>ben@lab.example</b>", "somebody"] {
        assert!(page.contains(name), "{name}: {page}");
    }
    assert!(!page.contains("intruder"), "{page}");
    // The simulation server itself asks for the administrator's password, with a form.
    let sign_in = format!("https://{}/{}/sign-in", visitor.host, fleet.here.port);
    let answer = visitor.ask(&sign_in, &anna).await;
    assert_eq!(answer.status.as_u16(), 200);
    assert!(answer.text().contains("type=\"password\""), "{}", answer.text());
    assert_eq!(visitor.ask(&sign_in, &[anna[0], password]).await.status.as_u16(), 303);
}
