//! The WebSocket to `/slots` of a simulation server, over which it reserves slots for the line. Part of the monitor.
//!
//! It is opened again whenever it has ended. A server without `/slots` or with another `fleetKey` takes part in the line
//! by its reports alone.

use std::time::Duration;

use actix::prelude::*;
use actix_codec::Framed;
use awc::BoxedSocket;
use awc::error::WsClientError;
use awc::http::StatusCode;
use awc::ws::{Codec, Frame, Message as Text};
use futures_util::{SinkExt, StreamExt};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::time::{sleep, timeout};

use crate::shared::domain::{FleetKey, Hello, Offers, PublicAddress, Wishes};

/// What happens to a link.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct LinkEvent {
    /// The simulation server.
    pub server: PublicAddress,
    /// What has happened.
    pub change: LinkChange,
}

/// What happens to a link.
#[derive(Debug)]
pub enum LinkChange {
    /// The server reserves slots from now on.
    Up(Hello),
    /// It has reserved slots, or answers wishes.
    Offers(Offers),
    /// It reserves no more slots, but may again.
    Down,
    /// It has another key, and reserves none for this session server.
    Refused,
}

/// What a link needs.
pub(super) struct SlotLink {
    /// The simulation server.
    pub(super) server: PublicAddress,
    /// The URL of its `/slots`.
    pub(super) url: String,
    /// Opens connections to it.
    pub(super) client: awc::Client,
    /// The key of the fleet.
    pub(super) key: FleetKey,
    /// Receives what happens.
    pub(super) events: Recipient<LinkEvent>,
}

/// Why a link has ended.
#[derive(Debug, thiserror::Error)]
enum LinkError {
    #[error("it does not reserve slots")]
    Unsupported,
    #[error("its fleetKey is another one")]
    WrongKey,
    #[error("{0}")]
    Broken(String),
}

type Socket = Framed<BoxedSocket, Codec>;

/// Timeout of a new connection, and of the first messages on it.
const CONNECT: Duration = Duration::from_secs(5);
/// A server that sends nothing for this long is gone. It pings more often.
const SILENCE: Duration = Duration::from_mins(2);
/// Pause after a connection has broken.
const PAUSE: Duration = Duration::from_millis(500);
/// Pause if the server has no `/slots`, or another key.
const LONG_PAUSE: Duration = Duration::from_secs(30);

impl SlotLink {
    /// Keeps the link, for ever.
    pub(super) async fn keep(self, mut wishes: UnboundedReceiver<Wishes>) {
        let mut is_warned = false;
        loop {
            let Err(error) = self.open(&mut wishes).await else {
                return;
            };
            let is_refused = matches!(error, LinkError::WrongKey);
            self.tell(if is_refused {
                LinkChange::Refused
            } else {
                LinkChange::Down
            });
            log::debug!("{}: no slots are reserved: {error}", self.server);
            let pause = match error {
                LinkError::Broken(_) => PAUSE,
                LinkError::Unsupported => LONG_PAUSE,
                LinkError::WrongKey => {
                    if !is_warned {
                        log::warn!("{}: {error}: clients of the line get no passes to it", self.server);
                    }
                    is_warned = true;
                    LONG_PAUSE
                }
            };
            sleep(pause).await;
        }
    }

    /// Opens a link and keeps it until it ends. Returns without an error when its monitor has ended.
    async fn open(&self, wishes: &mut UnboundedReceiver<Wishes>) -> Result<(), LinkError> {
        let opening = timeout(CONNECT, self.client.ws(&self.url).connect()).await;
        let opened = opening.map_err(|_| LinkError::Broken("no connection in time".to_owned()))?;
        let (_, mut socket) = opened.map_err(|error| match error {
            WsClientError::InvalidResponseStatus(status) if status != StatusCode::SERVICE_UNAVAILABLE => {
                LinkError::Unsupported
            }
            error => LinkError::Broken(error.to_string()),
        })?;
        let hello: Hello = receive(&mut socket, CONNECT).await?;
        send(&mut socket, &hello.prove(&self.key)).await?;
        // A server with another key closes the connection.
        let first: Offers = receive(&mut socket, CONNECT).await.map_err(|error| match error {
            LinkError::Broken(_) => LinkError::WrongKey,
            error => error,
        })?;
        // Wishes for an earlier link.
        while wishes.try_recv().is_ok() {}
        self.tell(LinkChange::Up(hello));
        self.tell(LinkChange::Offers(first));
        loop {
            tokio::select! {
                offers = receive(&mut socket, SILENCE) => self.tell(LinkChange::Offers(offers?)),
                next = wishes.recv() => match next {
                    Some(next) => send(&mut socket, &next).await?,
                    None => return Ok(()),
                },
            }
        }
    }

    fn tell(&self, change: LinkChange) {
        self.events.do_send(LinkEvent {
            server: self.server.clone(),
            change,
        });
    }
}

async fn send(socket: &mut Socket, message: &impl Serialize) -> Result<(), LinkError> {
    let broken = |error: &dyn std::error::Error| LinkError::Broken(error.to_string());
    let text = serde_json::to_string(message).map_err(|error| broken(&error))?;
    socket
        .send(Text::Text(text.into()))
        .await
        .map_err(|error| broken(&error))
}

/// The next message. Pings are answered.
async fn receive<M: DeserializeOwned>(socket: &mut Socket, limit: Duration) -> Result<M, LinkError> {
    let broken = |why: &str| LinkError::Broken(why.to_owned());
    loop {
        let next = timeout(limit, socket.next())
            .await
            .map_err(|_| broken("it is silent"))?;
        match next {
            Some(Ok(Frame::Text(text))) => {
                return serde_json::from_slice(&text).map_err(|error| broken(&error.to_string()));
            }
            Some(Ok(Frame::Ping(content))) => {
                let answered = socket.send(Text::Pong(content)).await;
                answered.map_err(|error| broken(&error.to_string()))?;
            }
            Some(Ok(Frame::Pong(_))) => {}
            Some(Ok(_)) | None => return Err(broken("it has ended")),
            Some(Err(error)) => return Err(broken(&error.to_string())),
        }
    }
}
