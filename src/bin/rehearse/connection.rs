//! A WebSocket as a web page uses it: texts in both directions.

use std::time::{Duration, Instant};

use futures_util::{SinkExt, StreamExt};
use serde::Deserialize;
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{Connector, MaybeTlsStream, WebSocketStream, connect_async_tls_with_config};

use crate::http::encryption;

/// Timeout of connecting, and of sending a text.
const CONNECT: Duration = Duration::from_secs(20);
/// The largest message of a server, in bytes.
const LARGEST_MESSAGE: usize = 1 << 20;
/// The largest message of Webots, in bytes: the scene of a large world is one message.
const LARGEST_SCENE: usize = 64 << 20;

/// An open WebSocket.
pub(crate) struct Connection {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
}

/// Why a connection can't be used any more.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Ended {
    /// The connection can't be established.
    #[error("{0} can't be reached: {1}")]
    Unreachable(String, String),
    /// It is refused, with this status of HTTP.
    #[error("{0} can't be reached: HTTP error: {1}")]
    Refused(String, StatusCode),
    /// The peer has closed it.
    #[error("closed with {0}")]
    Closed(String),
    /// It broke.
    #[error("broken: {0}")]
    Broken(String),
    /// The expected message did not arrive in time; others may have.
    #[error("not within {} s", .0.as_secs())]
    Late(Duration),
    /// The peer has reported an error.
    #[error("{0}")]
    Fault(String),
}

/// The deadline of a step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Deadline {
    end: Instant,
    limit: Duration,
}

impl Deadline {
    /// A deadline after this time from now.
    pub(crate) fn within(limit: Duration) -> Self {
        Self {
            end: Instant::now() + limit,
            limit,
        }
    }
}

/// A text of Webots, unless it is `error: ...`, after which Webots sends nothing else.
///
/// # Errors
/// When the text is such an error.
pub(crate) fn unless_error(text: String) -> Result<String, Ended> {
    if text.starts_with("error:") {
        Err(Ended::Fault(text))
    } else {
        Ok(text)
    }
}

/// An update of the scene; only its time is parsed.
#[derive(Deserialize)]
struct Update {
    /// Simulated time, in milliseconds.
    time: f64,
}

/// The simulated time of an update, in milliseconds.
pub(crate) fn simulated_time(text: &str) -> Option<f64> {
    let update: Update = serde_json::from_str(text.strip_prefix("application/json:")?).ok()?;
    Some(update.time)
}

impl Connection {
    /// Connects to a WebSocket URL of a server.
    ///
    /// # Errors
    /// When the connection is not established in time.
    pub(crate) async fn open(url: &str) -> Result<Self, Ended> {
        Self::open_for(url, LARGEST_MESSAGE).await
    }

    /// Connects to a WebSocket URL of a Webots.
    ///
    /// # Errors
    /// When the connection is not established in time.
    pub(crate) async fn open_scene(url: &str) -> Result<Self, Ended> {
        Self::open_for(url, LARGEST_SCENE).await
    }

    async fn open_for(url: &str, largest: usize) -> Result<Self, Ended> {
        let config = WebSocketConfig::default()
            .max_message_size(Some(largest))
            .max_frame_size(Some(largest));
        let failed = |why: String| Ended::Unreachable(url.to_owned(), why);
        let connecting = connect_async_tls_with_config(url, Some(config), true, encryption().map(Connector::Rustls));
        let connected = actix_rt::time::timeout(CONNECT, connecting)
            .await
            .map_err(|_| failed("too slow".to_owned()))?;
        let (socket, _) = connected.map_err(|error| match error {
            Error::Http(answer) => Ended::Refused(url.to_owned(), answer.status()),
            error => failed(error.to_string()),
        })?;
        Ok(Self { socket })
    }

    /// Sends a text.
    ///
    /// # Errors
    /// When the connection is broken, or the peer does not read.
    pub(crate) async fn say(&mut self, text: &str) -> Result<(), Ended> {
        let sending = actix_rt::time::timeout(CONNECT, self.socket.send(Message::text(text)));
        let sent = sending.await.map_err(|_| Ended::Late(CONNECT))?;
        sent.map_err(|error| Ended::Broken(error.to_string()))
    }

    /// The next text.
    ///
    /// # Errors
    /// When the connection has ended.
    pub(crate) async fn receive(&mut self) -> Result<String, Ended> {
        loop {
            match self.socket.next().await {
                Some(Ok(Message::Text(text))) => return Ok(text.to_string()),
                Some(Ok(Message::Close(frame))) => {
                    let code = frame.map_or_else(|| "no code".to_owned(), |frame| frame.code.to_string());
                    return Err(Ended::Closed(code));
                }
                Some(Ok(_)) => {}
                None | Some(Err(Error::ConnectionClosed | Error::AlreadyClosed)) => {
                    return Err(Ended::Closed("no code".to_owned()));
                }
                Some(Err(error)) => return Err(Ended::Broken(error.to_string())),
            }
        }
    }

    /// The next text, if it arrives before the deadline, which a steady flow of texts does not extend.
    ///
    /// # Errors
    /// When the connection has ended, or the deadline has passed.
    pub(crate) async fn receive_by(&mut self, deadline: Deadline) -> Result<String, Ended> {
        let late = Ended::Late(deadline.limit);
        if Instant::now() >= deadline.end {
            return Err(late);
        }
        tokio::time::timeout_at(deadline.end.into(), self.receive())
            .await
            .unwrap_or(Err(late))
    }

    /// Closes the connection as a page does when its user leaves, with a short timeout.
    pub(crate) async fn close(mut self) {
        let closing = async {
            if self.socket.close(None).await.is_ok() {
                while let Some(Ok(_)) = self.socket.next().await {}
            }
        };
        // A peer that does not answer is left anyway.
        actix_rt::time::timeout(Duration::from_secs(2), closing).await.ok();
    }
}
