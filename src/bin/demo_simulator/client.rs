//! The actor of one WebSocket, created for each connection. It sends the peer's messages to the simulation, as events,
//! and the simulation's messages to the peer. The simulation reaches it through a `ClientHandle`.
//! Queues are bounded. A peer that sends faster than the simulation handles its messages is disconnected. The actor of
//! a peer that does not read is not polled, so that its mailbox fills up; the peer is disconnected once it reads again.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use actix::{Actor, ActorContext as _, AsyncContext as _, Handler, Message, Recipient, StreamHandler};
use actix_web_actors::ws::{self, CloseCode, CloseReason, WebsocketContext};
use bytestring::ByteString;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Limit of texts of the peer that the simulation has not handled yet.
const MAX_INCOMING: usize = 256;
/// Limit of texts that wait to be sent to the peer.
const MAX_OUTGOING: usize = 64;
/// Limit of updates of poses among these.
const MAX_UPDATES: usize = 4;

/// Identifies a connection; unique in a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ClientId(u64);

/// A message from the simulation to a client.
#[derive(Message)]
#[rtype(result = "()")]
enum Outgoing {
    Text(ByteString, Option<OwnedSemaphorePermit>),
    Close,
}

/// An event of a connection.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) enum Event {
    /// It was opened.
    Connected(ClientId, ClientHandle),
    /// The peer has sent a text. The permit counts it as one that is not handled yet.
    Received(ClientId, ByteString, OwnedSemaphorePermit),
    /// It is closed.
    Disconnected(ClientId),
}

/// The simulation's handle of a client.
pub(crate) struct ClientHandle {
    client: Recipient<Outgoing>,
    updates: Arc<Semaphore>,
}

impl ClientHandle {
    /// Queues a text. Returns false if the queue is full or the client has disconnected.
    pub(crate) fn send(&self, text: ByteString) -> bool {
        self.client.try_send(Outgoing::Text(text, None)).is_ok()
    }

    /// Queues an update of poses. Returns false if too many wait already.
    pub(crate) fn send_update(&self, text: ByteString) -> bool {
        let permit = Arc::clone(&self.updates).try_acquire_owned();
        permit.is_ok_and(|permit| self.client.try_send(Outgoing::Text(text, Some(permit))).is_ok())
    }

    /// Starts the closing handshake, after the queued texts.
    pub(crate) fn close(&self) {
        self.client.do_send(Outgoing::Close);
    }

    /// Disconnects the client without sending the queued texts.
    pub(crate) fn disconnect(&self) {
        self.updates.close();
    }
}

/// The actor of one WebSocket.
pub(crate) struct Client {
    id: ClientId,
    simulation: Recipient<Event>,
    incoming: Arc<Semaphore>,
    /// Closed when the client must be disconnected.
    updates: Arc<Semaphore>,
    /// Whether the closing handshake was started from here.
    closing: bool,
}

impl Client {
    /// A client that sends its events to `simulation`.
    pub(crate) fn new(simulation: Recipient<Event>) -> Self {
        static NEXT_ID: AtomicU64 = AtomicU64::new(1);
        let id = ClientId(NEXT_ID.fetch_add(1, Ordering::Relaxed));
        let [incoming, updates] = [MAX_INCOMING, MAX_UPDATES].map(|permits| Arc::new(Semaphore::new(permits)));
        Self {
            id,
            simulation,
            incoming,
            updates,
            closing: false,
        }
    }

    fn receive(&self, text: ByteString, ctx: &mut WebsocketContext<Self>) {
        match Arc::clone(&self.incoming).try_acquire_owned() {
            Ok(permit) => self.simulation.do_send(Event::Received(self.id, text, permit)),
            Err(_) => self.end(ctx, Some(CloseCode::Policy.into())),
        }
    }

    /// Sends a close frame, unless it has sent one, and ends without waiting for an answer.
    fn end(&self, ctx: &mut WebsocketContext<Self>, reason: Option<CloseReason>) {
        if !self.closing {
            ctx.close(reason);
        }
        ctx.stop();
    }
}

impl Actor for Client {
    type Context = WebsocketContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.set_mailbox_capacity(MAX_OUTGOING);
        let handle = ClientHandle {
            client: ctx.address().recipient(),
            updates: Arc::clone(&self.updates),
        };
        self.simulation.do_send(Event::Connected(self.id, handle));
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        self.simulation.do_send(Event::Disconnected(self.id));
    }
}

impl StreamHandler<Result<ws::Message, ws::ProtocolError>> for Client {
    fn handle(&mut self, message: Result<ws::Message, ws::ProtocolError>, ctx: &mut Self::Context) {
        match message {
            Ok(ws::Message::Close(reason)) => self.end(ctx, reason),
            Ok(ws::Message::Text(text)) => self.receive(text, ctx),
            Ok(ws::Message::Ping(data)) => ctx.pong(&data),
            Ok(ws::Message::Pong(_) | ws::Message::Nop) => (),
            Ok(ws::Message::Binary(_) | ws::Message::Continuation(_)) => {
                self.end(ctx, Some(CloseCode::Unsupported.into()));
            }
            Err(_) => self.end(ctx, Some(CloseCode::Protocol.into())),
        }
    }
}

impl Handler<Outgoing> for Client {
    type Result = ();

    fn handle(&mut self, message: Outgoing, ctx: &mut Self::Context) {
        match message {
            _ if self.updates.is_closed() => self.end(ctx, Some(CloseCode::Policy.into())),
            // Nothing may follow a close frame (RFC 6455, section 5.5.1).
            Outgoing::Text(..) if self.closing => {}
            Outgoing::Text(text, permit) => {
                ctx.text(text);
                drop(permit);
            }
            Outgoing::Close => {
                self.closing = true;
                // with any other code Webots' page reports a lost connection
                ctx.close(Some(CloseCode::Normal.into()));
            }
        }
    }
}
