//! Streams through the server (`"streaming": "relay"`): only their client receives what Webots sends, and all of it.

use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, WebSocketConfig};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use super::life::quick;
use super::scene::nothing_left;
use crate::support::http::{PASSWORD, get_as_administrator, get_with_password};
use crate::support::network::Network;
use crate::support::{Builder, Client, SOON, Server, Webots, arm, http, server_of, skip, until};

/// The headers of a WebSocket request.
const UPGRADE: &str = "Host: localhost\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
    Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";

/// A server that relays the streams of this Webots.
async fn relaying(webots: Webots, change: impl FnOnce(Builder) -> Builder) -> Server {
    let files = [
        ("worlds/textures/a.png", "a picture"),
        ("plugins/a.html", "<p>a page</p>"),
    ];
    let builder = quick(server_of(webots, 2)).set("streaming", "relay");
    builder.forge().commit("lab/arm", "main", &files);
    change(builder).start().await
}

/// The same with the demo simulator.
async fn relay(change: impl FnOnce(Builder) -> Builder) -> Server {
    relaying(Webots::launcher(), change).await
}

/// A client with a simulation, and the path of its stream.
async fn start(server: &Server) -> (Client, String) {
    let mut client = Client::connect(&server.websocket("/client")).await;
    client
        .send(&json!({"start": {"url": arm(), "resumable": true}}).to_string())
        .await;
    let path = path_of(server, &mut client).await;
    (client, path)
}

async fn path_of(server: &Server, client: &mut Client) -> String {
    let told = client.until("webots:").await;
    let beginning = format!("webots:ws://localhost:{}", server.port);
    told.strip_prefix(&beginning)
        .unwrap_or_else(|| panic!("{told}"))
        .to_owned()
}

pub(super) async fn look_on(server: &Server, path: &str) -> Client {
    Client::connect(&server.websocket(path)).await
}

/// The status code of the answer to a WebSocket request.
async fn refused(server: &Server, path: &str) -> u16 {
    Client::with_headers(&server.websocket(path), &[])
        .await
        .err()
        .unwrap_or(101)
}

/// Sends these bytes, and returns what is received until the connection ends.
async fn raw(server: &Server, bytes: &str) -> String {
    let mut socket = TcpStream::connect(server.address()).await.unwrap();
    socket.write_all(bytes.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    actix_rt::time::timeout(SOON, socket.read_to_end(&mut answer))
        .await
        .expect("the connection ends")
        .ok();
    String::from_utf8_lossy(&answer).into_owned()
}

type Socket<S> = WebSocketStream<S>;

/// A Webots whose side of the stream this test plays, on a server that relays to it.
struct Played {
    server: Server,
    listener: TcpListener,
}

impl Played {
    async fn new(change: impl FnOnce(Builder) -> Builder) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/stream.py");
        let port = listener.local_addr().unwrap().port();
        let webots = Webots::script(&format!("exec python3 '{script}' \"$@\" {port}"));
        let change = |builder: Builder| change(builder.set("isolation", "none"));
        Self {
            server: relaying(webots, change).await,
            listener,
        }
    }

    /// Both ends of a stream: the client's and Webots'.
    async fn connect(&self, path: &str) -> (Socket<MaybeTlsStream<TcpStream>>, Socket<TcpStream>) {
        let config = WebSocketConfig::default().max_frame_size(Some(64 << 20));
        let url = self.server.websocket(path);
        let client = tokio_tungstenite::connect_async_with_config(url, Some(config), true);
        let webots = async {
            let (socket, _) = self.listener.accept().await.unwrap();
            tokio_tungstenite::accept_async_with_config(socket, Some(config))
                .await
                .unwrap()
        };
        let both = actix_rt::time::timeout(SOON, async { tokio::join!(client, webots) })
            .await
            .expect("a connection");
        (both.0.unwrap().0, both.1)
    }

    /// Answers one request with these bytes, as Webots; returns the head of the request.
    async fn answer(&self, bytes: &[u8]) -> String {
        let (mut socket, _) = self.listener.accept().await.unwrap();
        let mut head = [0; 4096];
        let length = socket.read(&mut head).await.unwrap();
        socket.write_all(bytes).await.unwrap();
        String::from_utf8_lossy(&head[..length]).into_owned()
    }
}

async fn next<S>(socket: &mut Socket<S>) -> Option<Message>
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    let next = actix_rt::time::timeout(SOON, socket.next())
        .await
        .expect("something comes");
    next.and_then(Result::ok)
}

#[actix_rt::test]
async fn a_simulation_and_its_files_are_reached_through_the_server() {
    needs!("bwrap");
    for level in ["none", "sandbox"] {
        let server = relay(|builder| builder.set("isolation", level)).await;
        let (client, path) = start(&server).await;
        let mut viewer = look_on(&server, &path).await.with_running_scene().await;
        viewer.until("application/json:").await;
        // The path as Webots' page writes it, and as ours does.
        look_on(&server, &format!("{path}/")).await.send("w3d;broadcast").await;

        let picture = http::get(&server.url(&format!("{path}/worlds/textures/a.png"))).await;
        assert_eq!((picture.status.as_u16(), picture.text().as_str()), (200, "a picture"));
        let common = [("access-control-allow-origin", "*"), ("referrer-policy", "no-referrer")];
        let own = [
            ("content-type", "image/png"),
            ("cache-control", "public, max-age=3600"),
            ("content-length", "9"),
        ];
        for (name, value) in common
            .into_iter()
            .chain(own)
            .chain([("content-security-policy", "sandbox allow-scripts")])
        {
            assert_eq!(picture.header(name), Some(value), "{name}: {:?}", picture.headers);
        }
        let url = server.url(&format!("{path}/worlds/textures/a.png?now"));
        let again = awc::Client::new()
            .get(url)
            .insert_header(("if-none-match", picture.header("etag").unwrap()));
        assert_eq!(again.send().await.unwrap().status(), 304);
        let page = http::get(&server.url(&format!("{path}/plugins/a.html"))).await;
        assert_eq!(page.header("content-security-policy"), Some("sandbox allow-scripts"));
        assert_eq!(
            http::get(&server.url(&format!("{path}/worlds/none.png"))).await.status,
            404
        );
        client.close_with(1000).await;
        nothing_left(&server, 2).await;
    }
}

#[actix_rt::test]
async fn all_frames_and_close_codes_pass_in_both_directions() {
    let played = Played::new(|builder| builder).await;
    let (_client, path) = start(&played.server).await;
    let (mut viewer, mut webots) = played.connect(&path).await;
    let picture = vec![7; 4 << 20];
    for message in [
        Message::text("a text"),
        Message::binary(vec![0, 255]),
        Message::binary(picture),
        Message::text(""),
    ] {
        webots.send(message.clone()).await.unwrap();
        assert!(
            next(&mut viewer).await == Some(message.clone()),
            "{} bytes to the client",
            message.len()
        );
        viewer.send(message.clone()).await.unwrap();
        assert!(
            next(&mut webots).await == Some(message.clone()),
            "{} bytes to Webots",
            message.len()
        );
    }
    viewer.send(Message::Ping(vec![1].into())).await.unwrap();
    assert_eq!(next(&mut webots).await, Some(Message::Ping(vec![1].into())));
    webots.flush().await.unwrap();
    assert_eq!(next(&mut viewer).await, Some(Message::Pong(vec![1].into())));
    let frame = |code, reason: &str| CloseFrame {
        code: CloseCode::from(code),
        reason: reason.into(),
    };
    webots.send(Message::Close(Some(frame(4321, "enough")))).await.unwrap();
    assert_eq!(
        next(&mut viewer).await,
        Some(Message::Close(Some(frame(4321, "enough"))))
    );

    let (mut viewer, mut webots) = played.connect(&path).await;
    viewer.send(Message::Close(Some(frame(3000, "")))).await.unwrap();
    assert_eq!(next(&mut webots).await, Some(Message::Close(Some(frame(3000, "")))));

    // A connection that breaks on one side is broken on the other.
    let (viewer, mut webots) = played.connect(&path).await;
    drop(viewer);
    assert_eq!(next(&mut webots).await, None);

    let (mut viewer, webots) = played.connect(&path).await;
    drop(webots);
    assert_eq!(next(&mut viewer).await, None);
}

#[actix_rt::test]
async fn a_viewer_that_does_not_read_costs_nothing() {
    let played = Played::new(|builder| builder.set("timing.silence", 3600)).await;
    let (_client, path) = start(&played.server).await;
    let memory = || {
        let process = procfs::process::Process::new(played.server.pid()).unwrap();
        process.stat().unwrap().rss * procfs::page_size()
    };
    let (mut lazy, mut flood) = played.connect(&path).await;
    let (mut viewer, mut webots) = played.connect(&path).await;
    let before = memory();
    let frame = Message::binary(vec![0; 4 << 20]);
    let mut taken = 0;
    while let Ok(sent) = actix_rt::time::timeout(Duration::from_secs(2), flood.send(frame.clone())).await {
        sent.unwrap();
        taken += 4;
        assert!(taken < 100, "{taken} MiB wait for somebody who does not read");
        webots.send(Message::text("another")).await.unwrap();
        assert_eq!(next(&mut viewer).await, Some(Message::text("another")));
    }
    assert!(memory() < before + (16 << 20), "{} MiB more", (memory() - before) >> 20);
    // The other direction.
    let (mut flood, webots) = played.connect(&path).await;
    while let Ok(sent) = actix_rt::time::timeout(Duration::from_secs(2), flood.send(frame.clone())).await {
        sent.unwrap();
        taken += 4;
        assert!(taken < 200, "{taken} MiB wait for a Webots that does not read");
    }
    assert!(memory() < before + (16 << 20), "{} MiB more", (memory() - before) >> 20);
    drop(webots);
    // It receives all of it once it reads.
    assert_eq!(next(&mut lazy).await, Some(frame));
}

/// The number of bytes in the send queues of a server's connections, as far as the kernel tells.
fn send_queues(server: &Server) -> usize {
    let table = std::fs::read_to_string("/proc/net/tcp").unwrap();
    let queue = |line: &str| {
        let mut columns = line.split_whitespace().skip(1);
        let (_, port) = columns.next()?.split_once(':')?;
        let (sending, _) = columns.nth(2)?.split_once(':')?;
        (u16::from_str_radix(port, 16).ok()? == server.port).then(|| usize::from_str_radix(sending, 16).ok())?
    };
    table.lines().filter_map(queue).sum()
}

#[actix_rt::test]
async fn streams_that_nobody_reads_are_few_and_pin_little_memory() {
    let played = Played::new(|builder| builder.set("timing.silence", 3600)).await;
    let (_client, path) = start(&played.server).await;
    let mut streams = Vec::new();
    for _ in 0..8 {
        let (viewer, mut flood) = played.connect(&path).await;
        let frame = Message::binary(vec![0; 1 << 20]);
        while actix_rt::time::timeout(Duration::from_millis(500), flood.send(frame.clone()))
            .await
            .is_ok_and(|sent| sent.is_ok())
        {}
        streams.push((viewer, flood));
    }
    let pinned = send_queues(&played.server);
    // Linux doubles the limit of 256 KiB, and counts what it needs for itself.
    assert!(pinned > 0 && pinned < 8 * (512 << 10), "{pinned} bytes");
    let request = format!("GET {path} HTTP/1.1\r\n{UPGRADE}\r\n");
    let answer = raw(
        &played.server,
        &request.replace("upgrade\r\nUp", "upgrade, close\r\nUp"),
    )
    .await;
    assert!(answer.starts_with("HTTP/1.1 429 "), "{answer}");
    assert!(
        answer.ends_with("\r\n\r\nError: this simulation has too many open streams."),
        "{answer}"
    );
    streams.pop();
    until("one may come again", async || {
        let url = played.server.websocket(&path);
        let accepted = async { played.listener.accept().await.unwrap() };
        tokio::select! {
            refused = Client::with_headers(&url, &[]) => { assert_eq!(refused.err(), Some(429)); false }
            _ = accepted => true
        }
    })
    .await;
}

#[actix_rt::test]
async fn nothing_is_kept_of_a_stream_whose_client_does_not_close_it() {
    let played = Played::new(|builder| builder.set("timing.ping", 1).set("timing.silence", 6)).await;
    let (client, path) = start(&played.server).await;
    let files = || {
        std::fs::read_dir(format!("/proc/{}/fd", played.server.pid()))
            .unwrap()
            .count()
    };
    let (mut viewer, webots) = played.connect(&path).await;
    // A second one does not read.
    let (lazy, mut flood) = played.connect(&path).await;
    let frame = Message::binary(vec![0; 1 << 20]);
    while actix_rt::time::timeout(Duration::from_millis(500), flood.send(frame.clone()))
        .await
        .is_ok_and(|sent| sent.is_ok())
    {}
    let before = files();
    drop((webots, flood));
    assert_eq!(next(&mut viewer).await, None);
    // Each has a connection to its client, and one to Webots.
    until("both are gone", async || files() <= before - 4).await;
    drop((viewer, lazy, client));
}

#[actix_rt::test]
async fn a_busy_webots_keeps_its_client_waiting() {
    // Longer than any fixed limit that a handshake may have had.
    let patience = 12;
    let played = Played::new(|builder| builder.set("timing.answer", patience)).await;
    let (client, path) = start(&played.server).await;
    let url = played.server.websocket(&path);
    let opened = actix_rt::spawn(async move { tokio_tungstenite::connect_async(url).await });
    let (stream, _) = played.listener.accept().await.unwrap();
    let file = played.server.url(&format!("{path}/a.png"));
    let asked = actix_rt::spawn(async move { http::get(&file).await });
    let (_kept, _) = played.listener.accept().await.unwrap();
    let answer = asked.await.unwrap();
    assert_eq!(
        (answer.status.as_u16(), answer.text().as_str()),
        (
            504,
            "Error: the simulation is busy, and did not send this file within 12 s."
        )
    );
    assert!(!opened.is_finished());
    let mut webots = tokio_tungstenite::accept_async(stream).await.unwrap();
    let (mut viewer, _) = opened.await.unwrap().unwrap();
    webots.send(Message::text("a scene")).await.unwrap();
    assert_eq!(next(&mut viewer).await, Some(Message::text("a scene")));
    // Who waits when the simulation ends gets an answer.
    let url = played.server.websocket(&path);
    let waits = actix_rt::spawn(async move { Client::with_headers(&url, &[]).await.err() });
    let (_waiting, _) = played.listener.accept().await.unwrap();
    client.close_with(1000).await;
    let status = actix_rt::time::timeout(SOON, waits).await.expect("an answer").unwrap();
    assert_eq!(status, Some(502));
}

#[actix_rt::test]
async fn a_stream_that_the_server_ends_is_closed_with_1000_and_the_reason() {
    // Webots' own code when it is told to end is 1001.
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/going_away.py");
    let webots = |options: &str| Webots::script(&format!("exec python3 '{script}' {options} \"$@\""));
    let change = |builder: Builder| builder.set("isolation", "none").set("adminPassword", PASSWORD);
    let close = async |viewer: &mut Socket<MaybeTlsStream<TcpStream>>| loop {
        match next(viewer).await {
            Some(Message::Close(Some(close))) => return (u16::from(close.code), close.reason.to_string()),
            Some(Message::Text(text)) => assert_eq!(text.as_str(), "an update", "a whole frame"),
            other => panic!("{other:?}"),
        }
    };
    // The programs of a container are killed with the script that has started Webots.
    for options in ["--abrupt", ""] {
        let server = relaying(webots(options), change).await;
        let (client, path) = start(&server).await;
        let (mut viewer, _) = tokio_tungstenite::connect_async(server.websocket(&path)).await.unwrap();
        assert_eq!(next(&mut viewer).await, Some(Message::text("an update")));
        let stop = server.url(&format!("/simulations/{}/stop", client.id()));
        assert_eq!(http::post(&stop, Some(PASSWORD), "").await, 202);
        let reason = "The administrator has stopped it".to_owned();
        assert_eq!(close(&mut viewer).await, (1000, reason), "{options}");
    }
    let server = relaying(webots(""), change).await;

    let (client, path) = start(&server).await;
    let (mut viewer, _) = tokio_tungstenite::connect_async(server.websocket(&path)).await.unwrap();
    assert_eq!(next(&mut viewer).await, Some(Message::text("an update")));
    // Strangers see no process ids.
    let status = get_with_password(&server.url("/status"), PASSWORD).await.json();
    let all = status["simulations"].as_array().unwrap();
    let pid = all.iter().find(|one| one["id"] == client.id()).unwrap()["pid"]
        .as_i64()
        .unwrap();
    let webots = nix::unistd::Pid::from_raw(pid.try_into().unwrap());
    nix::sys::signal::kill(webots, nix::sys::signal::Signal::SIGTERM).unwrap();
    assert_eq!(close(&mut viewer).await, (1001, String::new()), "not the server's will");
    drop(client);

    let (_client, path) = start(&server).await;
    let (mut viewer, _) = tokio_tungstenite::connect_async(server.websocket(&path)).await.unwrap();
    assert_eq!(next(&mut viewer).await, Some(Message::text("an update")));
    server.signal(nix::sys::signal::Signal::SIGTERM);
    assert_eq!(close(&mut viewer).await, (1000, "The server was stopped".to_owned()));
}

#[actix_rt::test]
async fn a_watcher_gets_its_scene_while_time_runs() {
    let played = Played::new(|builder| builder.set("adminPassword", PASSWORD)).await;
    let (client, _) = start(&played.server).await;
    let path = watched_by(&played.server, &client).await;
    let (mut watcher, mut webots) = played.connect(&path).await;
    // Webots sends updates to everybody.
    let update = Message::text("application/json:{}");
    webots.send(update.clone()).await.unwrap();
    assert_eq!(next(&mut watcher).await, Some(update.clone()));
    for text in ["pause", "w3d;broadcast", "w3d;broadcast", "w3d", "x3d;broadcast"] {
        watcher.send(Message::text(text)).await.unwrap();
    }
    for text in ["w3d;broadcast", "x3d;broadcast"] {
        assert_eq!(next(&mut webots).await, Some(Message::text(text)), "each kind, once");
    }
    webots.send(update.clone()).await.unwrap();
    assert_eq!(next(&mut watcher).await, Some(update));
}

#[actix_rt::test]
async fn a_viewer_that_has_vanished_is_noticed_though_nothing_is_sent() {
    let Some(network) = Network::hide_from_others() else {
        return skip("packets can't be filtered");
    };
    let played = Played::new(|builder| builder.set("timing.ping", 1).set("timing.silence", 6)).await;
    let (_client, path) = start(&played.server).await;
    let (viewer, mut webots) = played.connect(&path).await;
    let MaybeTlsStream::Plain(tcp) = viewer.get_ref() else {
        panic!("{viewer:?}")
    };
    let _lost = network.lose(1.0, &[tcp.local_addr().unwrap().port().to_string()]);
    assert_eq!(next(&mut webots).await, None);
}

#[actix_rt::test]
async fn streams_have_connections_of_their_own() {
    let played = Played::new(|builder| builder.set("maxClients", 2)).await;
    let (client, path) = start(&played.server).await;
    let (_other, others) = start(&played.server).await;
    let mut streams = Vec::new();
    for _ in 0..7 {
        streams.push(played.connect(&path).await);
        streams.push(played.connect(&others).await);
    }
    assert_eq!(refused(&played.server, &path).await, 503);
    assert_eq!(
        http::get(&played.server.url(&format!("{path}/a.png"))).await.status,
        503
    );
    assert_eq!(played.server.simulations().await.len(), 2);
    let (mut viewer, mut webots) = streams.remove(0);
    viewer.close(None).await.unwrap();
    while next(&mut webots).await.is_some() {}
    drop((viewer, webots));
    // Without a key it is refused, but not for lack of room.
    let upgrade = format!("GET {path} HTTP/1.1\r\nHost: a\r\nConnection: upgrade, close\r\nUpgrade: websocket\r\n\r\n");
    until("there is room again", async || {
        raw(&played.server, &upgrade).await.starts_with("HTTP/1.1 400 ")
    })
    .await;
    client.leave().await;
}

#[actix_rt::test]
async fn no_trick_leads_anywhere_else() {
    let played = Played::new(|builder| builder).await;
    let server = &played.server;
    let (_client, path) = start(server).await;
    let headers = "Host: localhost\r\nConnection: close\r\n";
    let other = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let elsewhere = other.local_addr().unwrap();
    let token = path.rsplit('/').next().unwrap();
    let wrong = format!("{}{}", &token[..47], if token.ends_with('0') { '1' } else { '0' });
    for path in [
        format!("{path}/../status"),
        format!("{path}/%2e%2e/a.png"),
        format!("{path}/a%2f..%2fb"),
        format!("{path}//{elsewhere}/"),
        format!("{path}@{elsewhere}/"),
        format!("{path}:80/a.png"),
        format!("{path}/a%0d%0aHost:%20{elsewhere}"),
        format!("/%73tream/{token}/a.png"),
        format!("/stream/{wrong}/a.png"),
        format!("/stream/{}/a.png", &token[..47]),
        format!(
            "/stream/{}/a.png",
            token.replace(|one: char| one.is_ascii_digit(), "%30")
        ),
        "/stream/".to_owned(),
        "/stream".to_owned(),
    ] {
        for headers in [headers, UPGRADE] {
            let answer = raw(server, &format!("GET {path} HTTP/1.1\r\n{headers}\r\n")).await;
            assert!(answer.starts_with("HTTP/1.1 404 "), "{path}: {answer}");
            assert!(!answer.contains(&token[16..]), "{answer}");
        }
    }
    for (request, status) in [
        (
            format!("POST {path}/a.png HTTP/1.1\r\n{headers}Content-Length: 1\r\n\r\nx"),
            405,
        ),
        (format!("PUT {path}/a.png HTTP/1.1\r\n{headers}\r\n"), 405),
        (format!("CONNECT {elsewhere} HTTP/1.1\r\n{headers}\r\n"), 404),
        (
            format!("GET {path}/a.png HTTP/1.1\r\n{headers}Content-Length: 1\r\n\r\nx"),
            400,
        ),
        (
            format!("GET {path}/a.png HTTP/1.1\r\n{headers}Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n"),
            400,
        ),
        (
            format!("GET {path} HTTP/1.1\r\n{UPGRADE}Content-Length: 1\r\n\r\nx"),
            400,
        ),
        (
            format!("GET {path} HTTP/1.1\r\n{UPGRADE}Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n\r\n"),
            400,
        ),
        (
            format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: upgrade, close\r\nUpgrade: h2c\r\n\r\n"),
            400,
        ),
        (
            format!("GET {path}/{} HTTP/1.1\r\n{headers}\r\n", "x".repeat(200_000)),
            431,
        ),
        (
            format!("GET /client HTTP/1.1\r\n{UPGRADE}Content-Length: 1\r\n\r\nx"),
            400,
        ),
        (
            format!("GET /client HTTP/1.1\r\n{UPGRADE}Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n\r\n"),
            400,
        ),
    ] {
        let answer = raw(server, &request).await;
        let shown: String = request.chars().take(300).collect();
        assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{shown}: {answer}");
        assert!(
            !shown.contains("/client") || answer.ends_with("Error: a request for this has no body."),
            "{answer}"
        );
    }
    // No request has reached Webots or the address that it named.
    let reached = actix_rt::time::timeout(Duration::from_millis(200), async {
        tokio::select! { one = played.listener.accept() => one, one = other.accept() => one }
    });
    assert!(reached.await.is_err());

    // A request in absolute form, as for a proxy, goes to Webots; a second request behind it gets no answer.
    let absolute =
        format!("GET http://{elsewhere}{path}/a.png?x=1 HTTP/1.1\r\n{headers}X-Secret: y\r\nAuthorization: z\r\n\r\n");
    let second = format!("GET {path}/second.png HTTP/1.1\r\n{headers}\r\n");
    let webots = played.answer(b"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:1/\r\nContent-Length: 2\r\n\r\nok");
    let both = format!("{absolute}{second}");
    let (answer, head) = tokio::join!(raw(server, &both), webots);
    let port = server.port + 1;
    assert!(head.starts_with("GET /a.png?x=1 HTTP/1.1\r\n"), "{head}");
    assert!(head.contains(&format!("\r\nHost: 127.0.0.1:{port}\r\n")), "{head}");
    let names: Vec<&str> = head
        .lines()
        .skip(1)
        .filter_map(|line| Some(line.split_once(':')?.0))
        .collect();
    assert_eq!(names, ["Content-Length", "Connection", "Host", "Date"], "{head}");
    assert!(
        answer.starts_with("HTTP/1.1 302 Found\r\n") && !answer.contains("ocation:"),
        "{answer}"
    );
    assert_eq!(answer.matches("HTTP/1.1 ").count(), 1, "{answer}");
    assert!(!server.log().contains(&token[16..]));
}

#[actix_rt::test]
async fn a_webots_that_does_not_answer_costs_its_client_an_error() {
    let played = Played::new(|builder| builder).await;
    let (_client, path) = start(&played.server).await;
    let url = played.server.url(&format!("{path}/a.png"));
    for nonsense in ["", "nonsense\r\n\r\n", "HTTP/1.1 101 Switching Protocols\r\n\r\n"] {
        let (answer, _) = tokio::join!(http::get(&url), played.answer(nonsense.as_bytes()));
        assert_eq!(answer.status, 502, "{nonsense}");
        let (status, _) = tokio::join!(refused(&played.server, &path), played.answer(nonsense.as_bytes()));
        assert_eq!(status, 502, "{nonsense}");
    }
    // An answer without a body ends with its head.
    let headers = "Host: localhost\r\nIf-None-Match: \"x\"\r\nConnection: close\r\n";
    let request = format!("GET {path}/a.png HTTP/1.1\r\n{headers}\r\n");
    let webots = played.answer(b"HTTP/1.1 304 Not Modified\r\nETag: \"x\"\r\n\r\n");
    let (answer, head) = tokio::join!(raw(&played.server, &request), webots);
    assert!(head.contains("\r\nIf-None-Match: \"x\"\r\n"), "{head}");
    assert!(
        answer.starts_with("HTTP/1.1 304 ") && answer.split_once("\r\n\r\n").unwrap().1.is_empty(),
        "{answer}"
    );
}

#[actix_rt::test]
async fn a_token_is_valid_as_long_as_its_simulation() {
    let server = relay(|builder| builder.set("adminPassword", PASSWORD)).await;
    let (mut client, path) = start(&server).await;
    let resume = client.token().await;
    let _watcher = look_on(&server, &watched_by(&server, &client).await).await;
    client.until("watched: 1").await;
    drop(client);
    server.until_away(1).await;
    let mut client = Client::resuming(&server, &resume).await;
    assert_eq!(path_of(&server, &mut client).await, path);
    client.until("watched: 1").await;
    let mut viewer = look_on(&server, &path).await.with_scene().await;

    let (other, others) = start(&server).await;
    assert_ne!(path, others);
    client.close_with(1000).await;
    viewer.closed().await;
    until("the token is gone", async || refused(&server, &path).await == 404).await;
    assert_eq!(
        http::get(&server.url(&format!("{path}/worlds/textures/a.png")))
            .await
            .status,
        404
    );
    assert_eq!(
        http::get(&server.url(&format!("{others}/worlds/textures/a.png")))
            .await
            .status,
        200
    );
    // Also if the next simulation has the same port.
    let (_next, third) = start(&server).await;
    assert_eq!(refused(&server, &path).await, 404);
    assert_ne!(third, path);
    drop(other);
    let mut told = server.log();
    for page in ["/status", "/monitor", "/metrics"] {
        told += &http::get(&server.url(page)).await.text();
    }
    for path in [path, others, third] {
        assert!(!told.contains(&path["/stream/".len() + 16..]), "{told}");
    }
}

#[actix_rt::test]
async fn a_stranger_sees_no_port_and_steers_nobody() {
    let password = |builder: Builder| builder.set("adminPassword", PASSWORD);
    for (mode, has_password) in [("direct", false), ("direct", true), ("relay", false), ("relay", true)] {
        let server = relay(|builder| {
            let builder = builder.set("streaming", mode);
            if has_password { password(builder) } else { builder }
        })
        .await;
        let client = Client::ready(&server).await;
        let port = server.port + 1;
        let is_shown = (mode, has_password) == ("direct", false);
        let simulation = server.simulations().await.remove(0);
        assert_eq!(
            simulation["port"],
            if is_shown { json!(port) } else { Value::Null },
            "{mode} {has_password}"
        );
        let page = server.monitor().await;
        assert_eq!(page.contains(&format!(">{port}<")), is_shown, "{mode} {has_password}");
        // Credentials may be meant for another service, so a wrong password is not refused.
        for (password, shown) in [("wrong", Value::Null), (PASSWORD, json!(port))]
            .into_iter()
            .filter(|_| has_password)
        {
            let answer = get_with_password(&server.url("/status"), password).await;
            assert_eq!(
                (answer.status.as_u16(), &answer.json()["simulations"][0]["port"]),
                (200, &shown),
                "{password}"
            );
        }
        // If there is a password, outputs are for administrators only.
        let url = server.url(&format!("/output?id={}", client.id()));
        client.leave().await;
        nothing_left(&server, 2).await;
        let mut text = String::new();
        until("its events are kept", async || {
            text = get_as_administrator(&url).await.text();
            text.contains("ready")
        })
        .await;
        let port = format!("port {port}: ready");
        assert!(!text.contains(&port), "{mode} {has_password}: {text}");
        assert!(server.log().contains(&port), "the log is the administrator's");
    }

    // An attack through the relay, with all that a stranger can learn, including the path of a stream of his own.
    let server = relay(|builder| builder).await;
    let (_victim, path) = start(&server).await;
    let (_stranger, own) = start(&server).await;
    let mut victim = look_on(&server, &path).await.with_running_scene().await;
    let number = &path["/stream/".len()..][..16];
    let secret = &own["/stream/".len() + 16..];
    for guess in [
        format!("/stream/{number}{secret}"),
        format!("{own}/../{number}{secret}"),
        "/stream/2001".to_owned(),
    ] {
        assert_eq!(refused(&server, &guess).await, 404, "{guess}");
    }
    let mut stranger = look_on(&server, &own).await.with_scene().await;
    stranger.send("pause").await;
    stranger.until("paused by client").await;
    for _ in 0..20 {
        assert!(
            victim.until("").await.starts_with("application/json:"),
            "{:?}",
            victim.heard.last()
        );
    }
}

#[actix_rt::test]
async fn pages_of_other_origins_start_nothing_and_get_no_stream() {
    let server = relay(|builder| builder.set("allowedOrigins", json!(["https://lab.org"]))).await;
    let (_client, path) = start(&server).await;
    // Webots' own viewer runs in a frame with an opaque origin.
    for (origin, may_start, allowed) in [
        ("https://lab.org", true, true),
        ("null", false, true),
        ("https://evil.org", false, false),
    ] {
        let status = async |path: &str| {
            Client::with_headers(&server.websocket(path), &[("origin", origin)])
                .await
                .err()
                .unwrap_or(101)
        };
        assert_eq!(status("/client").await, if may_start { 101 } else { 403 }, "{origin}");
        assert_eq!(status(&path).await, if allowed { 101 } else { 403 }, "{origin}");
        let file = server.url(&format!("{path}/worlds/textures/a.png"));
        let answer = awc::Client::new()
            .get(file)
            .insert_header(("origin", origin))
            .send()
            .await
            .unwrap();
        assert_eq!(answer.status(), if allowed { 200 } else { 403 }, "{origin}");
    }
}

/// Opens an administrator's watch page of a client's simulation, and returns the path of its stream.
pub(super) async fn watched_by(server: &Server, client: &Client) -> String {
    let url = server.url(&format!("/watch?id={}", client.id()));
    let answer = get_as_administrator(&url).await;
    assert_eq!(
        (answer.status.as_u16(), answer.header("referrer-policy")),
        (200, Some("same-origin"))
    );
    let page = answer.text();
    let (_, rest) = page.split_once("data-stream=\"").unwrap();
    format!("/{}", rest.split_once('"').unwrap().0)
}

#[actix_rt::test]
async fn an_administrator_watches_and_changes_nothing() {
    for mode in ["direct", "relay"] {
        let change = |builder: Builder| builder.set("adminPassword", PASSWORD).set("streaming", mode);
        let server = relay(change).await;
        let mut client = Client::start(&server, &arm()).await;
        let address = client.until("webots:").await["webots:".len()..].to_owned();
        let mut student = Client::connect(&address).await.with_running_scene().await;

        let path = watched_by(&server, &client).await;
        let mut watcher = look_on(&server, &path).await;
        assert_eq!(client.until("watched").await, "watched: 1");
        // Until it asks only to watch, its messages are ignored.
        for text in ["pause", "w3d", "robot:a:b;broadcast"] {
            watcher.send(text).await;
        }
        // Webots sends updates to every connection, but no scene to this one.
        for _ in 0..10 {
            assert!(watcher.until("").await.starts_with("application/json:"));
        }
        watcher.send("w3d;broadcast").await;
        watcher.until("scene load completed").await;
        for text in ["pause", "reset", "w3d", "step", "load:worlds/a.wbt"] {
            watcher.send(text).await;
        }
        watcher.send_binary(b"pause").await;
        for _ in 0..20 {
            assert!(
                student.until("").await.starts_with("application/json:"),
                "{:?}",
                student.heard.last()
            );
        }
        watcher.until("application/json:").await;
        let files = server.url(&format!("{path}/worlds/textures/a.png"));
        assert_eq!(http::get(&files).await.status, 200);
        // The token is for one connection, and invalid after it.
        assert_eq!(refused(&server, &path).await, 404);
        let mut second = look_on(&server, &watched_by(&server, &client).await).await;
        second.send("w3d;broadcast").await;
        second.until("scene load completed").await;
        drop(second);
        watcher.close_with(1000).await;
        assert_eq!(client.until("watched").await, "watched: 0");
        assert_eq!(http::get(&files).await.status, 404);

        assert!(server.log().contains("watches"));
        assert!(!server.log().contains(&path["/stream/".len() + 16..]));
        client.leave().await;
        nothing_left(&server, 2).await;
    }
}

#[actix_rt::test]
async fn nobody_watches_without_the_password() {
    let server = relay(|builder| builder).await;
    let (client, _) = start(&server).await;
    let watch = format!("/watch?id={}", client.id());
    assert_eq!(http::get(&server.url(&watch)).await.status, 403, "there is no password");
    assert!(!server.monitor().await.contains("watch?"));

    let server = relay(|builder| builder.set("adminPassword", PASSWORD)).await;
    let (client, _) = start(&server).await;
    let watch = format!("/watch?id={}", client.id());
    assert_eq!(http::get(&server.url(&watch)).await.status, 401);
    let link = format!("href=\"{}\"", &watch[1..]);
    assert!(!server.monitor().await.contains(&link));
    let page = get_as_administrator(&server.url("/monitor")).await.text();
    assert!(page.contains(&link), "{page:?}");
    let ask = async |id: &str, password: &str| {
        get_with_password(&server.url(&format!("/watch?id={id}")), password)
            .await
            .status
            .as_u16()
    };
    assert_eq!(ask(client.id(), "wrong").await, 401);
    for id in ["", "x", "20261122T220517042-17", "%3Cscript%3E"] {
        assert_eq!(ask(id, PASSWORD).await, 404, "{id}");
    }
}
