//! The line: clients that wait for a slot, at simulation servers that only report.

use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::stand_in::{Manner, StandIn};
use super::{addresses, until_states};
use crate::support::client::{Client, Heard};
use crate::support::git::world;
use crate::support::program::{Builder, Server, session_server};
use crate::support::{SOON, http, until};

/// A client in the line, and its ticket.
struct Waiting(Client, String);

impl Waiting {
    async fn enter(session: &Server, owner: &str) -> Self {
        Self::come_back(session, owner, "").await
    }

    async fn come_back(session: &Server, owner: &str, ticket: &str) -> Self {
        let mut client = Client::connect(&session.websocket("/session")).await;
        let url = world(&format!("{owner}/arm"), "main", "worlds/a.wbt");
        client
            .send(&json!({"url": url, "wait": true, "ticket": ticket}).to_string())
            .await;
        let ticket = client.until("ticket: ").await.replace("ticket: ", "");
        Self(client, ticket)
    }

    async fn position(&mut self) -> String {
        self.0.until("queue: ").await
    }

    async fn address(&mut self) -> String {
        self.0.until("ws://").await
    }
}

fn full() -> Manner {
    Manner::status(10.0, 1, 1)
}

async fn one_full_server(builder: impl Fn(Builder) -> Builder) -> (StandIn, Server) {
    let server = StandIn::start(full());
    let session = builder(session_server(&[server.address()])).start().await;
    until_states(&session, &["full"]).await;
    (server, session)
}

#[actix_rt::test]
async fn clients_get_their_turn_in_the_order_in_which_they_came() {
    let (server, session) = one_full_server(|builder| builder).await;
    let mut line = Vec::new();
    for ahead in 0..3 {
        let mut client = Waiting::enter(&session, "lab").await;
        assert_eq!(client.position().await, format!("queue: {ahead}"));
        line.push(client);
    }
    // Whoever asks without waiting gets nothing, and hears that nothing is free.
    let mut listener = Client::connect(&session.websocket("/")).await;
    listener.until("0").await;
    for arrivals in 2.. {
        let Some(mut next) = (!line.is_empty()).then(|| line.remove(0)) else {
            break;
        };
        let free = json!({"load": 10, "instances": {"running": 0, "places": 1, "arrivals": arrivals - 1}});
        server.set(Manner::Status(free));
        assert_eq!(next.address().await, server.url());
        assert!(
            !next.0.heard.iter().any(|text| text.starts_with("pass:")),
            "{:?}",
            next.0.heard
        );
        let taken = json!({"load": 10, "instances": {"running": 1, "places": 1, "arrivals": arrivals}});
        server.set(Manner::Status(taken));
        for (ahead, one) in line.iter_mut().enumerate() {
            assert_eq!(one.position().await, format!("queue: {ahead}"));
        }
        until_states(&session, &["full"]).await;
    }
    assert_eq!(listener.heard, ["0"]);
}

#[actix_rt::test]
async fn a_free_slot_is_given_at_once() {
    let server = StandIn::start(Manner::idle(3.0, 10));
    let session = session_server(&[server.address()]).start().await;
    until_states(&session, &["up"]).await;
    let mut client = Waiting::enter(&session, "lab").await;
    assert_eq!(client.address().await, server.url());
    assert!(
        !client.0.heard.iter().any(|text| text.starts_with("queue:")),
        "{:?}",
        client.0.heard
    );
    let mut wrong = Client::connect(&session.websocket("/session")).await;
    wrong
        .send(r#"{"url": "https://github.com/lab", "wait": true, "reason": true}"#)
        .await;
    assert!(wrong.until("reason: ").await.contains("invalid-world"));
    assert!(wrong.until("Error: ").await.contains("Wrong Webots simulation URL"));
}

#[actix_rt::test]
async fn a_ticket_keeps_the_place_over_a_reload_and_a_restart_of_the_session_server() {
    let (_server, mut session) = one_full_server(|builder| builder.set("fleetKey", "a secret of this test")).await;
    let Waiting(first, ticket) = Waiting::enter(&session, "lab").await;
    let mut second = Waiting::enter(&session, "lab").await;
    assert_eq!(second.position().await, "queue: 1");
    first.leave().await;
    assert_eq!(second.position().await, "queue: 0");
    let mut first = Waiting::come_back(&session, "lab", &ticket).await;
    assert_eq!(first.position().await, "queue: 0");
    assert_eq!(second.position().await, "queue: 1");
    // The ticket on a second connection: the first one loses the place.
    let mut again = Waiting::come_back(&session, "lab", &first.1).await;
    assert_eq!(again.position().await, "queue: 0");
    first.0.until("Error: another connection has this place").await;
    session.signal(nix::sys::signal::Signal::SIGKILL);
    assert_eq!(session.ended().await, None);
    let folder = &session.folder;
    let config: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.join("config.json")).unwrap()).unwrap();
    let server = config["simulationServers"][0].as_str().unwrap().to_owned();
    let session = session_server(&[server])
        .set("fleetKey", "a secret of this test")
        .start()
        .await;
    until_states(&session, &["full"]).await;
    // They come back in another order, and a new one in between.
    let mut second = Waiting::come_back(&session, "lab", &second.1).await;
    assert_eq!(second.position().await, "queue: 0");
    let mut third = Waiting::enter(&session, "lab").await;
    assert_eq!(third.position().await, "queue: 1");
    let mut again = Waiting::come_back(&session, "lab", &again.1).await;
    assert_eq!(again.position().await, "queue: 0");
    assert_eq!(second.position().await, "queue: 1");
    assert_eq!(third.position().await, "queue: 2");
    // A forged one is worth nothing.
    let mut forged = Waiting::come_back(&session, "lab", &again.1.replace(|_| true, "A")).await;
    assert_eq!(forged.position().await, "queue: 3");
}

#[actix_rt::test]
async fn who_got_a_server_that_then_drains_waits_in_its_old_place() {
    let (server, session) = one_full_server(|builder| builder).await;
    let Waiting(mut client, ticket) = Waiting::enter(&session, "lab").await;
    let mut other = Waiting::enter(&session, "lab").await;
    assert_eq!(other.position().await, "queue: 1");
    server.set(Manner::idle(1.0, 1));
    client.until("ws://").await;
    let draining = json!({"load": 1, "draining": true, "instances": {"running": 0, "places": 1, "arrivals": 1}});
    server.set(Manner::Status(draining));
    until_states(&session, &["draining"]).await;
    assert_eq!(other.position().await, "queue: 0");
    let mut again = Waiting::come_back(&session, "lab", &ticket).await;
    assert_eq!(again.position().await, "queue: 0");
    assert_eq!(other.position().await, "queue: 1");
}

#[actix_rt::test]
async fn a_turn_is_for_the_world_that_was_asked_for() {
    let key = |builder: Builder| builder.set("fleetKey", "a secret of this test");
    let (server, session) = one_full_server(key).await;
    let Waiting(mut client, ticket) = Waiting::enter(&session, "lab").await;
    server.set(Manner::idle(1.0, 1));
    client.until("ws://").await;
    drop(client);
    server.set(Manner::status(1.0, 1, 1));
    until_states(&session, &["full"]).await;
    // With the ticket of that turn for another world: it waits again, and does not hear a turn for the first.
    let mut other = Waiting::come_back(&session, "other", &ticket).await;
    assert_eq!(other.position().await, "queue: 0");
}

/// A WebSocket that can be cut like a cable.
async fn bare(session: &Server) -> TcpStream {
    let mut socket = TcpStream::connect(session.address()).await.unwrap();
    let head = "GET /session HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
                Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
    socket.write_all(head.as_bytes()).await.unwrap();
    let mut heard = [0; 512];
    assert!(socket.read(&mut heard).await.unwrap() > 0);
    socket
}

#[actix_rt::test]
async fn clients_whose_connections_break_while_they_enter_leave_nothing_in_the_line() {
    const CLIENTS: usize = 400;
    let (_server, session) = one_full_server(|builder| builder).await;
    let url = world("lab/arm", "main", "worlds/a.wbt");
    let request = json!({"url": url, "wait": true}).to_string();
    let length = u8::try_from(request.len()).unwrap();
    assert!(length < 126);
    // A text whose mask changes nothing.
    let frame = [&[0x81, 0x80 | length, 0, 0, 0, 0], request.as_bytes()].concat();
    let mut sockets = Vec::new();
    for _ in 0..CLIENTS {
        sockets.push(bare(&session).await);
    }
    // All ask at once, so that some break before they are answered.
    for socket in &mut sockets {
        socket.write_all(&frame).await.unwrap();
    }
    for socket in sockets {
        socket.set_zero_linger().unwrap();
    }
    let mut after = Waiting::enter(&session, "lab").await;
    until("only the client that is there waits", async || {
        session.status().await["line"]["waiting"] == 1
    })
    .await;
    until(
        "nobody is ahead of it",
        async || matches!(after.0.next_within(SOON).await, Some(Heard::Text(text)) if text == "queue: 0"),
    )
    .await;
}

#[actix_rt::test]
async fn free_slots_belong_to_those_who_wait_for_them_and_to_nobody_else() {
    let servers = [Manner::of_owner("lab"), Manner::of_owner("school")].map(StandIn::start);
    let taken = |owner: &str| {
        let allowed = [format!("https://github.com/{owner}")];
        Manner::Status(
            json!({"load": 1, "instances": {"running": 1, "places": 1}, "docker": false,
            "allowedRepositories": allowed}),
        )
    };
    servers[0].set(taken("lab"));
    let session = session_server(&addresses(&servers)).start().await;
    until_states(&session, &["full", "up"]).await;
    let mut waits = Waiting::enter(&session, "lab").await;
    assert_eq!(waits.position().await, "queue: 0");
    // A world that another server takes is not blocked by it.
    let mut lucky = Waiting::enter(&session, "school").await;
    assert_eq!(lucky.address().await, servers[1].url());
    let request = async |owner: &str| {
        let url = world(&format!("{owner}/arm"), "main", "worlds/a.wbt");
        http::get(&session.url(&format!("/session?url={url}"))).await.text()
    };
    assert_eq!(request("school").await, servers[1].url());
    assert!(
        request("lab")
            .await
            .starts_with("Error: no simulation server available")
    );
    let mut refused = Client::connect(&session.websocket("/session")).await;
    let url = world("stranger/arm", "main", "worlds/a.wbt");
    refused.send(&json!({"url": url, "wait": true}).to_string()).await;
    refused.until("Error: no simulation server accepts").await;
    // One who gives up leaves nothing behind.
    waits.0.send(r#"{"wait": false}"#).await;
    until("nobody waits", async || session.status().await["line"]["waiting"] == 0).await;
    servers[0].set(Manner::of_owner("lab"));
    until_states(&session, &["up", "up"]).await;
    assert_eq!(request("lab").await, servers[0].url());
}

#[actix_rt::test]
async fn the_monitor_shows_who_waits_for_what_and_since_when() {
    let (_server, session) = one_full_server(|builder| builder).await;
    let page = async || http::get(&session.url("/monitor")).await.text();
    let row = async |owner: &str| {
        let page = page().await;
        let key = format!(r#"data-key="https://github.com/{owner}/arm">"#);
        let (_, row) = page.split_once(&key)?;
        Some(row.split_once("</tr>").unwrap().0.to_owned())
    };
    assert!(row("lab").await.is_none() && page().await.contains("Nobody waits for a place."));
    let first = Waiting::enter(&session, "lab").await;
    let _second = Waiting::enter(&session, "lab").await;
    let _third = Waiting::enter(&session, "school").await;
    let lab = row("lab").await.unwrap();
    assert!(
        lab.contains("github.com/lab/arm</th>") && lab.contains(r#"data-value="2">2</td>"#),
        "{lab}"
    );
    let since = lab
        .split_once(r#"<time datetime=""#)
        .unwrap()
        .1
        .split('"')
        .next()
        .unwrap();
    let since = humantime::parse_rfc3339(since).unwrap();
    assert!(since.elapsed().unwrap() < SOON, "{lab}");
    assert!(row("school").await.unwrap().contains(r#"data-value="1">1</td>"#));
    assert!(page().await.contains("3 wait in the line"));
    first.0.leave().await;
    until("one of lab is left", async || {
        row("lab").await.is_some_and(|row| row.contains(">1</td>"))
    })
    .await;
}

#[actix_rt::test]
async fn a_user_has_one_place() {
    let builder = |builder: Builder| builder.set("userHeader", "X-User");
    let (_server, session) = one_full_server(builder).await;
    let enter = async |user| {
        let url = session.websocket("/session");
        let mut client = Client::with_headers(&url, &[("x-user", user)]).await.unwrap();
        let url = world("lab/arm", "main", "worlds/a.wbt");
        let request = json!({"url": url, "wait": true, "reason": true});
        client.send(&request.to_string()).await;
        client.until("ticket: ").await;
        client
    };
    let mut first = enter("anna").await;
    assert_eq!(first.until("queue: ").await, "queue: 0");
    let mut other = Waiting::enter(&session, "lab").await;
    assert_eq!(other.position().await, "queue: 1");
    let mut second = enter(" anna").await;
    assert!(first.until("reason: ").await.contains(r#""code":"taken-over""#));
    first.until("Error: another connection has this place").await;
    assert_eq!(second.until("queue: ").await, "queue: 0");
    assert_eq!(session.status().await["line"]["waiting"], 2);
    let metrics = session.metrics().await;
    assert!(metrics.contains("webots_session_waiting 2"), "{metrics}");
    // Who has no name is nobody else.
    let mut nameless = [enter("").await, enter(" ").await];
    assert_eq!(nameless[0].until("queue: ").await, "queue: 2");
    assert_eq!(nameless[1].until("queue: ").await, "queue: 3");
}
