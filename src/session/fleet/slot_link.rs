//! The WebSocket to `/slots` of a simulation server, over which it reserves slots for the line, and tells which simulations
//! it has. Part of the monitor.
//!
//! It is opened again whenever it has ended. A server takes part in the line by its reports alone while it says that it
//! reserves no slots, or when no link could be opened several times in a row: it has another `fleetKey`, or a proxy does
//! not pass `/slots` on.

use std::collections::HashMap;
use std::future::pending;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;
use actix_codec::Framed;
use awc::BoxedSocket;
use awc::ws::{CloseCode, Codec, Frame, Message as Text};
use futures_util::{SinkExt, StreamExt};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::sync::{oneshot, watch};
use tokio::time::{Instant, sleep, timeout, timeout_at};

use crate::session::class::{Roster, StopRequest};
use crate::shared::domain::{
    FleetKey, Follow, Hello, MAX_LINK_MESSAGE, Offers, PublicAddress, RosterUpdate, ServerRun, StopOrder, Stopped,
    ToSessionServer, ToSimulationServer,
};

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
    /// It reserves no more slots, but may again soon.
    Down,
    /// No link can be opened, although it says that it reserves slots.
    Failed,
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
    /// Learns which simulations run there.
    pub(super) roster: Arc<Roster>,
    /// The URL of the page that lists them.
    pub(super) page: String,
}

/// What a server does for the roster, as long as its link lasts.
struct Followed {
    server: PublicAddress,
    roster: Arc<Roster>,
    requests: UnboundedReceiver<StopRequest>,
    /// The requests that wait for an answer, by their numbers.
    pending: HashMap<u64, oneshot::Sender<Vec<String>>>,
    number: u64,
}

/// Why a link has ended.
#[derive(Debug, thiserror::Error)]
enum LinkError {
    #[error("its fleetKey is another one")]
    WrongKey,
    #[error("it refuses what it was sent")]
    Refused,
    #[error("{0}")]
    Broken(String),
}

type Socket = Framed<BoxedSocket, Codec>;

/// Longest message, in bytes: one has at most fifty simulations, whose texts are bounded.
const MAX_MESSAGE: usize = 1024 * 1024;
/// Timeout of a new connection, and of the first messages on it.
const CONNECT: Duration = Duration::from_secs(5);
/// A server that sends nothing, or reads nothing, for this long is gone. By default it pings each 20 seconds.
const SILENCE: Duration = Duration::from_mins(2);
/// Pause after a connection has broken.
const PAUSE: Duration = Duration::from_millis(500);
/// Pause after each message and ping of a server, so that none can keep this one busy with them.
const BETWEEN_MESSAGES: Duration = Duration::from_millis(1);
/// Pause if no link is expected, or none could be opened several times.
const LONG_PAUSE: Duration = Duration::from_secs(30);
/// So many times in a row: a server that has just come may not answer the first.
const ATTEMPTS: u32 = 5;

impl SlotLink {
    /// Keeps the link, for ever. `reserves` is whether the server says that it reserves slots.
    pub(super) async fn keep(
        self,
        mut messages: UnboundedReceiver<ToSimulationServer>,
        mut reserves: watch::Receiver<bool>,
    ) {
        let mut failed = 0;
        loop {
            let error = match self.open().await {
                Ok(link) => {
                    failed = 0;
                    match self.use_link(link, &mut messages).await {
                        Ok(()) => return,
                        Err(error) => error,
                    }
                }
                Err(error) => {
                    failed = if *reserves.borrow_and_update() { failed + 1 } else { 0 };
                    error
                }
            };
            log::debug!("{}: no slots are reserved: {error}", self.server);
            if failed == ATTEMPTS {
                log::warn!(
                    "{}: its /slots can't be used: {error}: clients of the line get no passes to it",
                    self.server
                );
            }
            let has_failed = failed >= ATTEMPTS;
            self.tell(if has_failed {
                LinkChange::Failed
            } else {
                LinkChange::Down
            })
            .await;
            let is_expected = *reserves.borrow_and_update() && !has_failed;
            let pause = if is_expected { PAUSE } else { LONG_PAUSE };
            timeout(pause, reserves.changed()).await.ok();
        }
    }

    /// Opens a link: the first message of the server, and its first answer.
    async fn open(&self) -> Result<(Socket, Hello, Offers), LinkError> {
        let opening = timeout(CONNECT, self.client.ws(&self.url).max_frame_size(MAX_MESSAGE).connect()).await;
        let opened = opening.map_err(|_| LinkError::Broken("no connection in time".to_owned()))?;
        let (_, mut socket) = opened.map_err(|error| LinkError::Broken(error.to_string()))?;
        let mut heard = Instant::now();
        let hello: Hello = receive(&mut socket, &mut heard, CONNECT).await?;
        send(&mut socket, &hello.prove(&self.key)).await?;
        // A server with another key refuses the proof.
        let first = receive(&mut socket, &mut heard, CONNECT)
            .await
            .map_err(|error| match error {
                LinkError::Refused => LinkError::WrongKey,
                error => error,
            })?;
        Ok((socket, hello, first))
    }

    /// Uses a link until it ends. Returns without an error when its monitor has ended.
    async fn use_link(
        &self,
        (mut socket, hello, first): (Socket, Hello, Offers),
        messages: &mut UnboundedReceiver<ToSimulationServer>,
    ) -> Result<(), LinkError> {
        // Those for an earlier link.
        while messages.try_recv().is_ok() {}
        let mut followed = hello.roster.then(|| Followed::new(self, hello.server));
        self.tell(LinkChange::Up(hello)).await;
        self.tell(LinkChange::Offers(first)).await;
        let mut heard = Instant::now();
        let mut watching = self.roster.watching();
        if followed.is_some() {
            watching.mark_changed();
        }
        loop {
            tokio::select! {
                message = receive(&mut socket, &mut heard, SILENCE) => {
                    match message? {
                        ToSessionServer::Offers(offers) => self.tell(LinkChange::Offers(offers)).await,
                        ToSessionServer::Roster(update) => self.follow(update)?,
                        ToSessionServer::Stopped(stopped) => {
                            if let Some(followed) = &mut followed {
                                followed.answer(stopped);
                            }
                        }
                    }
                    sleep(BETWEEN_MESSAGES).await;
                }
                next = messages.recv() => match next {
                    Some(next) => send(&mut socket, &next).await?,
                    None => return Ok(()),
                },
                order = next_order(&mut followed) => send(&mut socket, &ToSimulationServer::Stop(order)).await?,
                Ok(()) = watching.changed(), if followed.is_some() => {
                    let follow = Follow {
                        figures: *watching.borrow_and_update() > 0,
                        page: self.page.clone(),
                    };
                    send(&mut socket, &ToSimulationServer::Follow(follow)).await?;
                }
            }
        }
    }

    fn follow(&self, update: RosterUpdate) -> Result<(), LinkError> {
        let updated = self.roster.update(&self.server, update);
        updated.map_err(|error| {
            log::warn!("{}: {error}", self.server);
            LinkError::Broken(error.to_string())
        })
    }

    /// Tells what has happened, once the receiver has handled what came before. A receiver that has ended needs nothing.
    async fn tell(&self, change: LinkChange) {
        let event = LinkEvent {
            server: self.server.clone(),
            change,
        };
        self.events.send(event).await.ok();
    }
}

impl Followed {
    fn new(link: &SlotLink, run: ServerRun) -> Self {
        Self {
            requests: link.roster.link(link.server.clone(), run),
            server: link.server.clone(),
            roster: Arc::clone(&link.roster),
            pending: HashMap::new(),
            number: 0,
        }
    }

    fn answer(&mut self, Stopped { number, ids }: Stopped) {
        if let Some(done) = self.pending.remove(&number) {
            // Nobody may wait for it any more.
            done.send(ids).ok();
        }
    }
}

impl Drop for Followed {
    fn drop(&mut self) {
        self.requests.close();
        self.roster.unlink(&self.server);
    }
}

/// The next order for the server; never, if it takes none.
async fn next_order(followed: &mut Option<Followed>) -> StopOrder {
    let Some(followed) = followed else {
        return pending().await;
    };
    let Some(request) = followed.requests.recv().await else {
        return pending().await;
    };
    followed.pending.retain(|_, done| !done.is_closed());
    followed.number += 1;
    followed.pending.insert(followed.number, request.done);
    StopOrder {
        number: followed.number,
        ids: request.ids,
        reason: request.reason,
        by: request.by,
    }
}

async fn send(socket: &mut Socket, message: &impl Serialize) -> Result<(), LinkError> {
    let broken = |error: &dyn std::error::Error| LinkError::Broken(error.to_string());
    let text = serde_json::to_string(message).map_err(|error| broken(&error))?;
    if text.len() > MAX_LINK_MESSAGE {
        // It would end the link, again and again.
        log::error!(
            "a message of {} bytes is too long for a simulation server: it is not sent",
            text.len()
        );
        return Ok(());
    }
    let sent = timeout(SILENCE, socket.send(Text::Text(text.into()))).await;
    sent.map_err(|error| broken(&error))?.map_err(|error| broken(&error))
}

/// The next message, at most this long after the server was `heard` last. Pings are answered.
async fn receive<M: DeserializeOwned>(
    socket: &mut Socket,
    heard: &mut Instant,
    limit: Duration,
) -> Result<M, LinkError> {
    let broken = |why: &str| LinkError::Broken(why.to_owned());
    loop {
        let next = timeout_at(*heard + limit, socket.next())
            .await
            .map_err(|_| broken("it is silent"))?;
        *heard = Instant::now();
        match next {
            Some(Ok(Frame::Text(text))) => {
                return serde_json::from_slice(&text).map_err(|error| broken(&error.to_string()));
            }
            Some(Ok(Frame::Ping(content))) => {
                let answered = timeout(limit, socket.send(Text::Pong(content))).await;
                let answered = answered.map_err(|_| broken("it reads nothing"))?;
                answered.map_err(|error| broken(&error.to_string()))?;
                sleep(BETWEEN_MESSAGES).await;
            }
            Some(Ok(Frame::Pong(_))) => sleep(BETWEEN_MESSAGES).await,
            Some(Ok(Frame::Close(Some(why)))) if why.code == CloseCode::Policy => return Err(LinkError::Refused),
            Some(Ok(_)) | None => return Err(broken("it has ended")),
            Some(Err(error)) => return Err(broken(&error.to_string())),
        }
    }
}
