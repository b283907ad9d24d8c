//! A web client: a WebSocket that waits for texts with a deadline.

use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{CloseCode, Data, OpCode};
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use super::SOON;

/// A WebSocket, and all texts received on it.
#[derive(Debug)]
pub struct Client {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    pub heard: Vec<String>,
}

/// What was received on a WebSocket.
#[derive(Debug)]
pub enum Heard {
    Text(String),
    Closed(Option<CloseFrame>),
}

impl Client {
    pub async fn connect(url: &str) -> Self {
        Self::try_connect(url)
            .await
            .unwrap_or_else(|error| panic!("{url}: {error}"))
    }

    /// Connects to a server that may be down.
    pub async fn try_connect(url: &str) -> Result<Self, String> {
        let connecting = actix_rt::time::timeout(SOON, tokio_tungstenite::connect_async(url)).await;
        let connected = connecting.map_err(|error| error.to_string())?;
        connected
            .map(|(socket, _)| Self::new(socket))
            .map_err(|error| error.to_string())
    }

    /// Uses an open connection.
    pub fn new(socket: WebSocketStream<MaybeTlsStream<TcpStream>>) -> Self {
        Self {
            socket,
            heard: Vec::new(),
        }
    }

    /// Connects to a simulation server and asks for a world.
    pub async fn start(server: &super::program::Server, world: &str) -> Self {
        Self::connect(&server.websocket("/client")).await.asking(world).await
    }

    /// Asks for a world.
    pub async fn asking(mut self, world: &str) -> Self {
        self.send(&serde_json::json!({"start": {"url": world}}).to_string())
            .await;
        self
    }

    /// A client whose simulation of the world of [`arm`](super::git::arm) is ready.
    pub async fn ready(server: &super::program::Server) -> Self {
        let mut client = Self::start(server, &super::git::arm()).await;
        client.until("webots:").await;
        client
    }

    /// A client with a ready simulation that it can resume, and the token for that.
    pub async fn resumable(server: &super::program::Server) -> (Self, String) {
        Self::connect(&server.websocket("/client"))
            .await
            .start_resumable()
            .await
    }

    /// A client that resumes a simulation with a token.
    pub async fn resuming(server: &super::program::Server, token: &str) -> Self {
        Self::connect(&server.websocket("/client")).await.resume(token).await
    }

    /// Requests the world of [`arm`](super::git::arm) as resumable; waits until it is ready, and for the token.
    pub async fn start_resumable(mut self) -> (Self, String) {
        self.send(&serde_json::json!({"start": {"url": super::git::arm(), "resumable": true}}).to_string())
            .await;
        self.until("webots:").await;
        let token = self.token().await;
        (self, token)
    }

    /// Resumes a simulation.
    pub async fn resume(mut self, token: &str) -> Self {
        self.send(&serde_json::json!({ "resume": token }).to_string()).await;
        self
    }

    /// The next token that the server sends.
    pub async fn token(&mut self) -> String {
        self.until("resume: ")
            .await
            .strip_prefix("resume: ")
            .unwrap()
            .to_owned()
    }

    /// Like [`Client::start`], but through a web server that reports this client address.
    pub async fn start_from(server: &super::program::Server, address: &str, world: &str) -> Self {
        Self::from_address(server, address).await.unwrap().asking(world).await
    }

    /// Connects to a simulation server as through a web server.
    pub async fn from_address(server: &super::program::Server, address: &str) -> Result<Self, u16> {
        Self::with_headers(&server.websocket("/client"), &[("x-forwarded-for", address)]).await
    }

    /// Connects with these headers. If the server refuses, returns the status of its answer.
    pub async fn with_headers(url: &str, headers: &[(&'static str, &str)]) -> Result<Self, u16> {
        let mut request = url.into_client_request().unwrap();
        for (name, value) in headers {
            request.headers_mut().append(*name, value.parse().unwrap());
        }
        match tokio_tungstenite::connect_async(request).await {
            Ok((socket, _)) => Ok(Self::new(socket)),
            Err(Error::Http(answer)) => Err(answer.status().as_u16()),
            Err(error) => panic!("{url}: {error}"),
        }
    }

    /// A viewer that has received the scene.
    pub async fn with_scene(mut self) -> Self {
        self.send("w3d").await;
        self.until("scene load completed").await;
        self
    }

    /// A viewer that has started the simulation.
    pub async fn with_running_scene(self) -> Self {
        let mut viewer = self.with_scene().await;
        viewer.send("real-time:-1").await;
        viewer.until("real-time").await;
        viewer
    }

    /// The next simulated time that the viewer receives, in milliseconds.
    pub async fn time(&mut self) -> f64 {
        let update = self.until("application/json:").await;
        let update: serde_json::Value = serde_json::from_str(update.trim_start_matches("application/json:")).unwrap();
        update["time"].as_f64().unwrap()
    }

    /// The id of its simulation, from the texts received so far.
    pub fn id(&self) -> &str {
        let told = self.heard.iter().find_map(|text| text.strip_prefix("session: "));
        told.unwrap_or_else(|| panic!("no id in {:#?}", self.heard))
    }

    pub async fn send(&mut self, text: &str) {
        self.socket.send(Message::text(text)).await.unwrap();
    }

    /// Sends a text over a connection that may be broken.
    pub async fn try_send(&mut self, text: &str) -> Result<(), String> {
        self.socket
            .send(Message::text(text))
            .await
            .map_err(|error| error.to_string())
    }

    /// Requests a reset of a controller; returns the answer.
    pub async fn reset(&mut self, controller: &str) -> String {
        self.send(&serde_json::json!({ "reset controller": controller }).to_string())
            .await;
        loop {
            let answer = self.until("").await;
            if answer.starts_with("reset") || answer.starts_with("loading: Error") {
                return answer;
            }
        }
    }

    /// Sends a text in one frame per piece.
    pub async fn send_pieces(&mut self, pieces: &[&[u8]]) {
        for (number, piece) in pieces.iter().enumerate() {
            let kind = if number == 0 { Data::Text } else { Data::Continue };
            let frame = Frame::message(piece.to_vec(), OpCode::Data(kind), number + 1 == pieces.len());
            self.socket.send(Message::Frame(frame)).await.unwrap();
            // Control frames may come between the fragments of a message.
            self.socket.send(Message::Ping(vec![1].into())).await.unwrap();
        }
    }

    /// Sends a binary message.
    pub async fn send_binary(&mut self, content: &[u8]) {
        self.socket.send(Message::binary(content.to_vec())).await.unwrap();
    }

    /// The next text, or the end of the connection.
    pub async fn next(&mut self) -> Heard {
        match actix_rt::time::timeout(SOON, self.read()).await {
            Ok(heard) => heard,
            Err(_) => panic!("nothing more came after {:#?}", self.heard),
        }
    }

    /// The next text or the end of the connection, if it comes within this time.
    pub async fn next_within(&mut self, time: Duration) -> Option<Heard> {
        actix_rt::time::timeout(time, self.read()).await.ok()
    }

    async fn read(&mut self) -> Heard {
        loop {
            match self.socket.next().await {
                Some(Ok(Message::Text(text))) => {
                    self.heard.push(text.to_string());
                    return Heard::Text(text.to_string());
                }
                Some(Ok(Message::Close(frame))) => return Heard::Closed(frame),
                Some(Ok(_)) => {}
                Some(Err(_)) | None => return Heard::Closed(None),
            }
        }
    }

    /// The next text that begins like this; skips others. An empty beginning does not match the id of a simulation,
    /// which precedes all answers, nor a reason, which precedes each error.
    pub async fn until(&mut self, beginning: &str) -> String {
        let is_before =
            |text: &str| beginning.is_empty() && (text.starts_with("session: ") || text.starts_with("reason: "));
        loop {
            match self.next().await {
                Heard::Text(text) if text.starts_with(beginning) && !is_before(&text) => return text,
                Heard::Text(_) => {}
                Heard::Closed(frame) => panic!("closed ({frame:?}) before {beginning:?}; heard {:#?}", self.heard),
            }
        }
    }

    /// Like [`Client::until`], with a longer timeout: a busy machine may have to build an image first.
    pub async fn patiently(&mut self, beginning: &str) -> String {
        self.within(beginning, Duration::from_mins(5)).await
    }

    /// Like [`Client::until`], with this timeout.
    pub async fn within(&mut self, beginning: &str, time: Duration) -> String {
        let heard = async {
            loop {
                match self.read().await {
                    Heard::Text(text) if text.starts_with(beginning) => return text,
                    Heard::Text(_) => {}
                    Heard::Closed(frame) => panic!("closed ({frame:?}) before {beginning:?}; heard {:#?}", self.heard),
                }
            }
        };
        let heard = actix_rt::time::timeout(time, heard).await;
        heard.unwrap_or_else(|_| panic!("{beginning:?} did not come"))
    }

    /// The close code that ends the connection; `None` if it ended without one.
    pub async fn closed(&mut self) -> Option<u16> {
        self.closed_with().await.map(|(code, _)| code)
    }

    /// The close code that ends the connection, and its reason; `None` if it ended without them, for example within a
    /// frame.
    pub async fn closed_with(&mut self) -> Option<(u16, String)> {
        loop {
            if let Heard::Closed(frame) = self.next().await {
                return frame.map(|frame| (frame.code.into(), frame.reason.to_string()));
            }
        }
    }

    /// The last reason that the server has sent.
    pub fn reason(&self) -> serde_json::Value {
        let told = self.heard.iter().rev().find_map(|text| text.strip_prefix("reason: "));
        let told = told.unwrap_or_else(|| panic!("no reason in {:#?}", self.heard));
        serde_json::from_str(told).unwrap()
    }

    /// Whether nothing is received for this long.
    pub async fn is_silent(&mut self, time: Duration) -> bool {
        self.next_within(time).await.is_none()
    }

    /// Closes with this code, and waits for the close frame of the server as browsers do. Dropping a socket with unread
    /// data resets the connection, and the server may not see the code.
    pub async fn close_with(mut self, code: u16) {
        let frame = CloseFrame {
            code: CloseCode::from(code),
            reason: "".into(),
        };
        let closing = async {
            if self.socket.close(Some(frame)).await.is_ok() {
                while let Some(Ok(_)) = self.socket.next().await {}
            }
        };
        actix_rt::time::timeout(SOON, closing)
            .await
            .expect("the closing handshake");
    }

    /// Closes without a code.
    pub async fn leave(mut self) {
        self.socket.close(None).await.ok();
    }
}

/// The error that ends a client's request for a world.
pub async fn outcome(server: &super::program::Server, world: &str) -> String {
    let mut client = Client::start(server, world).await;
    let told = client.patiently("loading: Error:").await;
    // The text and the code agree on whether the client may try another server.
    let code = if told.contains(". Connect again: the session server") {
        1013
    } else {
        1000
    };
    assert_eq!(client.closed().await, Some(code), "{told}");
    told
}

/// Checks that a request for a world ends with an error that contains these words.
pub async fn is_told(server: &super::program::Server, world: &str, words: &str) {
    let told = outcome(server, world).await;
    assert!(told.contains(words), "{world}: {words:?} is not in {told}");
}
