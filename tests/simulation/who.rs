//! Who uses which simulation: the user that a trusted web server reports, and the name that a client gives itself.

use futures_util::StreamExt;
use serde_json::{Value, json};

use crate::support::http::{self, PASSWORD, get_as_administrator, get_with_password};
use crate::support::{Builder, Client, Server, arm, demo_server, until};

fn with_users(places: u16) -> Builder {
    demo_server(places)
        .set("adminPassword", PASSWORD)
        .set("userHeader", "X-Forwarded-User")
}

/// A client with headers of a web server, and with a name of its own choice.
async fn start(server: &Server, headers: &[(&'static str, &str)], name: Option<&str>) -> Client {
    let mut client = Client::with_headers(&server.websocket("/client"), headers)
        .await
        .unwrap();
    client
        .send(&json!({"start": {"url": arm(), "name": name}}).to_string())
        .await;
    client
}

async fn page(server: &Server) -> String {
    get_as_administrator(&server.url("/monitor")).await.text()
}

/// The first event for a live page with the password.
async fn event(server: &Server) -> String {
    let request = awc::Client::default()
        .get(server.url("/events"))
        .basic_auth("admin", PASSWORD);
    let mut answer = request.send().await.unwrap();
    let mut text = String::new();
    while !text.contains("simulations") || !text.ends_with("\n\n") {
        text.push_str(&String::from_utf8_lossy(&answer.next().await.unwrap().unwrap()));
    }
    text
}

#[actix_rt::test]
async fn a_name_is_for_administrators_alone_and_never_markup() {
    let server = with_users(2).start().await;
    let user = "<b>anna@lab</b>";
    let label = "\"<script>alert(1)</script>\u{202e}\n=1+1,x;=2";
    let mut client = start(&server, &[("x-forwarded-user", user)], Some(label)).await;
    client.until("webots:").await;
    let id = client.id().to_owned();
    let watch = server.url(&format!("/watch?id={id}"));
    let watched = get_as_administrator(&watch).await.text();
    assert!(
        watched.contains(&format!("href=\"{}\"", arm())) && watched.contains(">a.wbt</a>"),
        "{watched}"
    );
    let refused = http::get(&watch).await;
    assert_eq!((refused.status.as_u16(), refused.text().contains("anna")), (401, false));
    for text in [page(&server).await, event(&server).await, watched] {
        assert!(
            text.contains("anna@lab") && text.contains("alert(1)") && text.contains("unverified"),
            "{text}"
        );
        assert!(!text.contains("<b>anna") && !text.contains("<script>alert"), "{text}");
    }
    let output = server.url(&format!("/output?id={id}"));
    client.leave().await;
    let csv = || std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    until("it is in simulations.csv", async || csv().contains(&id)).await;
    let line = csv().lines().find(|line| line.starts_with(&id)).unwrap().to_owned();
    let written = "\"<b>anna@lab</b>\",\"\"\"<script>alert(1)</script>\u{fffd} =1+1,x;'=2\"";
    assert!(line.contains(written), "{line}");
    assert!(
        csv()
            .lines()
            .next()
            .unwrap()
            .contains(",reason,user,label (unverified),")
    );
    let log = server.log();
    assert!(
        log.lines()
            .any(|line| line.contains(&id) && line.contains("user \"<b>anna@lab</b>\"")),
        "{log}"
    );
    assert!(
        page(&server).await.contains("anna@lab"),
        "the simulations that ended have a name, too"
    );
    // Pages without the password.
    for path in ["/monitor", "/status", "/metrics", "/load"] {
        let text = http::get(&server.url(path)).await.text();
        assert!(!text.contains("anna") && !text.contains("alert(1)"), "{path}: {text}");
    }
    until("the output is kept", async || {
        get_as_administrator(&output).await.status == 200
    })
    .await;
    let kept = get_as_administrator(&output).await.text();
    assert!(
        kept.contains("asks for") && !kept.contains("anna") && !kept.contains("alert(1)"),
        "{kept}"
    );
    // If there is no password, no user is shown.
    let server = demo_server(1).set("userHeader", "X-Forwarded-User").start().await;
    let mut client = start(&server, &[("x-forwarded-user", user)], Some(label)).await;
    client.until("webots:").await;
    assert!(!page(&server).await.contains("anna"));
}

#[actix_rt::test]
async fn a_user_is_believed_from_a_trusted_web_server_only() {
    let anna = ("x-forwarded-user", "anna");
    for (trusted, header, headers, known) in [
        (json!(["127.0.0.1"]), "X-Forwarded-User", vec![anna], true),
        (json!([]), "X-Forwarded-User", vec![anna], false),
        (json!(["203.0.113.0/24"]), "X-Forwarded-User", vec![anna], false),
        (json!(["127.0.0.1"]), "X-Auth-Name", vec![anna], false),
        (
            json!(["127.0.0.1"]),
            "X-Forwarded-User",
            vec![anna, ("x-forwarded-user", "ben")],
            false,
        ),
    ] {
        let server = with_users(1)
            .set("trustedProxies", trusted.clone())
            .set("userHeader", header)
            .start()
            .await;
        let mut client = start(&server, &headers, None).await;
        client.until("webots:").await;
        assert_eq!(
            page(&server).await.contains("<b>anna</b>"),
            known,
            "{trusted} {header} {headers:?}"
        );
        assert_eq!(
            server.log().contains("user \"anna\""),
            known,
            "{trusted} {header} {headers:?}"
        );
    }
}

#[actix_rt::test]
async fn strangers_get_no_paths_process_ids_names_of_users_or_of_the_machine() {
    let server = with_users(1).start().await;
    let mut client = start(&server, &[("x-forwarded-user", "anna")], Some("Anna")).await;
    client.until("webots:").await;
    let strangers: Value = serde_json::from_str(&http::get(&server.url("/status")).await.text()).unwrap();
    let answer = get_with_password(&server.url("/status"), PASSWORD).await;
    let administrators: Value = serde_json::from_str(&answer.text()).unwrap();
    for (status, is_shown) in [(strangers, false), (administrators, true)] {
        let simulation = &status["simulations"][0];
        assert_eq!(simulation["pid"].is_i64(), is_shown, "{simulation}");
        assert_eq!(simulation["log"].is_string(), is_shown, "{simulation}");
        assert_eq!(
            (simulation["user"] == "anna", simulation["label"] == "Anna"),
            (is_shown, is_shown),
            "{simulation}"
        );
        assert_ne!(status["host"]["name"] == "", is_shown, "{}", status["host"]);
    }
    // The monitor tells the same. Without a password all visitors see the name.
    let shows_name = "<dt>Host</dt>";
    assert!(page(&server).await.contains(shows_name));
    let strangers = http::get(&server.url("/monitor")).await.text();
    assert!(!strangers.contains(shows_name), "{strangers}");
    let open = demo_server(1).start().await;
    assert!(http::get(&open.url("/monitor")).await.text().contains(shows_name));
}

#[actix_rt::test]
async fn one_user_has_a_share_of_the_places_wherever_it_is() {
    let server = with_users(4)
        .set("waitingLine", 4)
        .set("maxPlacesPerUser", 1)
        .start()
        .await;
    let from = async |user: &str, address: &str| {
        start(
            &server,
            &[("x-forwarded-user", user), ("x-forwarded-for", address)],
            None,
        )
        .await
    };
    let mut first = from("anna", "203.0.113.1").await;
    first.until("webots:").await;
    let mut waits = from("anna", "203.0.113.2").await;
    assert_eq!(waits.until("").await, "queue: 0");
    let told = from("anna", "203.0.113.3").await.until("").await;
    let words = "loading: Error: You have 1 places of this simulation server, and 1 more are waiting";
    assert!(told.starts_with(words), "{told}");
    // Another user of the same address, and a client without a user, overtake the waiting one.
    let mut other = from("ben", "203.0.113.1").await;
    other.until("webots:").await;
    let mut nameless = start(&server, &[("x-forwarded-for", "203.0.113.1")], Some("anna")).await;
    nameless.until("webots:").await;
    first.leave().await;
    waits.until("webots:").await;
}

#[actix_rt::test]
async fn who_has_sent_too_many_passwords_is_not_taken_for_a_stranger() {
    let server = with_users(1).start().await;
    let ask = async |path: &str, password| get_with_password(&server.url(path), password).await.status.as_u16();
    for _ in 0..40 {
        assert_eq!(ask("/monitor", PASSWORD).await, 200, "the right one does not count");
    }
    let guesses = futures_util::stream::iter(0..60).then(|_| ask("/monitor", "guess"));
    let answers: Vec<u16> = guesses.collect().await;
    assert!(
        answers.starts_with(&[200; 30]) && answers.ends_with(&[429; 10]),
        "{answers:?}"
    );
    for path in ["/monitor", "/events", "/status"] {
        assert_eq!(ask(path, PASSWORD).await, 429, "{path}");
    }
    assert_eq!(
        http::get(&server.url("/monitor")).await.status,
        200,
        "without a password it is the page for all"
    );
}
