//! The values that connected clients receive, and which clients are disconnected.

use std::time::Duration;

use futures_util::future::join_all;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::stand_in::{Manner, StandIn};
use super::{addresses, until_states};
use crate::support::client::Client;
use crate::support::program::{Server, session_server};
use crate::support::{http, until};

async fn clients_of(session: &Server) -> u64 {
    session.status().await["clients"].as_u64().unwrap()
}

/// A request for a WebSocket.
const UPGRADE: &[u8] = b"GET /session HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
                         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";

/// A WebSocket that is opened and never read.
async fn deaf(session: &Server) -> TcpStream {
    let mut stream = TcpStream::connect(session.address()).await.unwrap();
    stream.write_all(UPGRADE).await.unwrap();
    stream
}

#[actix_rt::test]
async fn no_value_comes_twice_however_a_server_flaps() {
    let servers = [StandIn::start(Manner::idle(1.0, 1000))];
    let session = session_server(&addresses(&servers))
        .set("loadRefresh", 0.01)
        .set("clientCost", 0.1)
        .start()
        .await;
    let paths = ["/session", "/"]
        .into_iter()
        .cycle()
        .map(|path| session.websocket(path));
    // More clients than are notified at a time.
    let mut clients = join_all(paths.take(150).map(|url| async move { Client::connect(&url).await })).await;
    let flap = async {
        for turn in 0..60 {
            let manner = match turn % 4 {
                0 => Manner::idle(99.0, 10),
                2 => Manner::Reset,
                _ => Manner::idle(1.0, 1000),
            };
            servers[0].set(manner);
            let seen = servers[0].requests();
            until("it was looked at", async || servers[0].requests() > seen + 1).await;
        }
    };
    flap.await;
    // More clients connect at the moment of the next change.
    servers[0].set(Manner::idle(99.0, 10));
    let url = session.websocket("/session");
    clients.extend(join_all((0..50).map(|_| Client::connect(&url))).await);
    until_states(&session, &["full"]).await;
    servers[0].set(Manner::idle(1.0, 1000));
    until_states(&session, &["up"]).await;
    for client in &mut clients {
        // A value for each change of the server, and no others. The last one may come after an answer.
        client.send("").await;
        client.until("ws://").await;
        if client
            .heard
            .iter()
            .rfind(|text| !text.starts_with("ws://"))
            .is_none_or(|value| value != "1")
        {
            client.until("1").await;
        }
        let values: Vec<&String> = client.heard.iter().filter(|text| !text.starts_with("ws://")).collect();
        assert!(
            values.iter().all(|value| ["0", "1"].contains(&value.as_str())),
            "{values:?}"
        );
        assert!(values.windows(2).all(|pair| pair[0] != pair[1]), "{values:?}");
        assert_eq!(values.last().unwrap().as_str(), "1");
    }
    assert!(
        clients[0].heard.len() > 20,
        "the server did not flap: {:?}",
        clients[0].heard
    );
}

#[actix_rt::test]
async fn a_silent_client_is_disconnected_in_time() {
    // The pings come at 3 and at 6 seconds.
    let session = session_server(&[])
        .set("timing", serde_json::json!({"ping": 3, "silence": 4}))
        .start()
        .await;
    let mut reader = Client::connect(&session.websocket("/session")).await;
    reader.until("0").await;
    let begin = std::time::Instant::now();
    // It receives everything, but answers no ping.
    let mut silent = deaf(&session).await;
    let mut rest = Vec::new();
    let closed = async {
        let end = actix_rt::time::timeout(Duration::from_secs(15), silent.read_to_end(&mut rest)).await;
        assert!(end.is_ok(), "its connection is still open");
        begin.elapsed().as_secs_f64()
    };
    // Pings are answered while reading.
    let (took, is_silent) = futures_util::future::join(closed, reader.is_silent(Duration::from_secs(6))).await;
    assert!((4.0..5.9).contains(&took), "closed after {took} s; the silence is 4 s");
    assert!(is_silent, "{:?}", reader.heard);
    assert_eq!(clients_of(&session).await, 1);
}

#[actix_rt::test]
async fn nothing_piles_up_for_a_client_that_asks_without_reading() {
    let session = session_server(&[]).start().await;
    let mut stream = deaf(&session).await;
    // A masked ping of 125 bytes.
    let frame = [&[0x89, 0x80 | 125, 0, 0, 0, 0][..], &[b'x'; 125]].concat();
    let mut flood = 0;
    let end = async {
        while stream.write_all(&frame).await.is_ok() {
            flood += 1;
            assert!(flood < 1_000_000, "it may ask for ever");
        }
    };
    actix_rt::time::timeout(crate::support::SOON, end)
        .await
        .expect("it is sent away");
    until("it is forgotten", async || clients_of(&session).await == 0).await;
    assert!(
        session.log().contains("asks too much between two pings"),
        "{}",
        session.log()
    );
}

#[actix_rt::test]
async fn too_many_clients_are_refused() {
    for (builder, least) in [
        (session_server(&[]).set("maxClients", 2), 2),
        (session_server(&[]).files(200), 20),
    ] {
        let session = builder.start().await;
        let connect = || async { tokio_tungstenite::connect_async(session.websocket("/session")).await };
        let mut clients = Vec::new();
        let refused = loop {
            match connect().await {
                Ok(client) => clients.push(client),
                Err(refused) => break refused,
            }
            assert!(clients.len() < 200, "there are more clients than files");
        };
        assert!(refused.to_string().contains("503"), "{refused}");
        assert!(clients.len() >= least, "only {} clients", clients.len());
        // Further connections wait; the server keeps running, and accepts clients again when there is room.
        let waiting: Vec<_> = join_all((0..300).map(|_| TcpStream::connect(session.address()))).await;
        drop((waiting, clients));
        until("there is room again", async || connect().await.is_ok()).await;
        assert!(!session.log().contains("open files"), "{}", session.log());
        let is_told = session.log().contains("200 files may be open, which is enough for");
        assert_eq!(is_told, least == 20, "{}", session.log());
    }
    let said = session_server(&[]).files(128).refused(1).await;
    assert!(
        said.starts_with("error: 128 files may be open, which is not enough for one client"),
        "{said}"
    );
}

#[actix_rt::test]
async fn a_client_that_reads_no_page_is_sent_away() {
    let session = session_server(&[])
        .set("timing", serde_json::json!({"ping": 0.5, "silence": 1}))
        .start()
        .await;
    let mut deaf = TcpStream::connect(session.address()).await.unwrap();
    let request = b"GET /assets/viewer.js HTTP/1.1\r\nHost: localhost\r\n\r\n";
    // The server stops reading requests because its answers are not read; then it cuts the connection.
    let flood = async { while deaf.write_all(request).await.is_ok() {} };
    actix_rt::time::timeout(Duration::from_secs(40), flood)
        .await
        .expect("the connection is still open");
    assert_eq!(http::get(&session.url("/health")).await.status, 200);
}

/// An open connection over which one request was answered.
async fn served(session: &Server) -> Option<TcpStream> {
    let mut stream = TcpStream::connect(session.address()).await.unwrap();
    stream
        .write_all(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
        .await
        .ok()?;
    let length = stream.read(&mut [0; 512]).await.ok()?;
    (length > 0).then_some(stream)
}

#[actix_rt::test]
async fn an_address_has_only_so_many_connections_of_any_kind() {
    let builder = session_server(&[])
        .set("trustedProxies", serde_json::json!([]))
        .set("maxClientsPerAddress", 2);
    let session = builder.start().await;
    let mut open = Vec::new();
    // The connection of the start check may still be open.
    until("two for each of two clients stay", async || {
        open.extend(served(&session).await);
        open.len() == 4
    })
    .await;
    let more = join_all((0..4).map(|_| served(&session))).await;
    assert!(more.iter().all(Option::is_none), "it has more than four connections");
    drop(open);
    until("there is room again", async || {
        http::try_get(&session.url("/health")).await.is_ok()
    })
    .await;
}
