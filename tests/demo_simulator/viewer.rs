//! A WebSocket client of a simulator.

use std::net::SocketAddr;

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::{WebSocketStream, client_async};

use super::simulator::DEADLINE;

/// A WebSocket client.
pub(crate) struct Viewer {
    pub(crate) socket: WebSocketStream<TcpStream>,
}

impl Viewer {
    pub(crate) async fn connect(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).await.unwrap();
        let (socket, _) = client_async(format!("ws://{address}/"), stream).await.unwrap();
        Self { socket }
    }

    pub(crate) async fn say(&mut self, text: &str) {
        self.socket.send(Message::text(text)).await.unwrap();
    }

    /// The next text.
    pub(crate) async fn hear(&mut self) -> String {
        match timeout(DEADLINE, self.socket.next()).await.expect("heard nothing in time") {
            Some(Ok(Message::Text(text))) => text.to_string(),
            other => panic!("expected a text, got {other:?}"),
        }
    }

    /// The next texts must start like these.
    pub(crate) async fn hears(&mut self, starts: &[&str]) {
        for start in starts {
            let text = self.hear().await;
            assert!(text.starts_with(start), "expected {start:?}, heard {text:?}");
        }
    }

    /// The scene must come, perhaps after some progress; then the state, which is returned.
    pub(crate) async fn hears_scene(&mut self) -> String {
        while !self.hear_world().await.starts_with("world:") {}
        self.hears(&["model:<?xml", "application/json:{\"time\":", "scene load completed"]).await;
        self.hear().await
    }

    async fn hear_world(&mut self) -> String {
        let text = self.hear().await;
        let is_expected = text.starts_with("loading:") || text.starts_with("world:");
        assert!(is_expected, "expected a world, heard {text:?}");
        text
    }

    /// Skips pose updates until the given text comes; the updates.
    pub(crate) async fn hears_after_updates(&mut self, text: &str) -> Vec<String> {
        let mut updates = Vec::new();
        loop {
            let heard = self.hear().await;
            if heard == text {
                return updates;
            }
            assert!(heard.starts_with("application/json:"), "expected {text:?}, heard {heard:?}");
            updates.push(heard);
        }
    }

    /// Makes sure that nothing is on its way: the answer to a ping comes next.
    pub(crate) async fn hears_nothing(&mut self) {
        self.socket.send(Message::Ping(b"anything?".to_vec().into())).await.unwrap();
        match timeout(DEADLINE, self.socket.next()).await.expect("no pong in time") {
            Some(Ok(Message::Pong(data))) => assert_eq!(data.as_ref(), b"anything?"),
            other => panic!("expected nothing, got {other:?}"),
        }
    }

    /// The connection must be closed by the simulator, with this code.
    pub(crate) async fn is_closed(&mut self, code: CloseCode) {
        match timeout(DEADLINE, self.socket.next()).await.expect("not closed in time") {
            Some(Ok(Message::Close(Some(frame)))) => assert_eq!(frame.code, code),
            other => panic!("expected a close frame, got {other:?}"),
        }
    }
}

/// The simulation time of an update, in milliseconds.
pub(crate) fn time_of(update: &str) -> f64 {
    let json = update.strip_prefix("application/json:").expect(update);
    let value: serde_json::Value = serde_json::from_str(json).unwrap();
    value["time"].as_f64().unwrap()
}
