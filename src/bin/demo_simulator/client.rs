//! The actor of one WebSocket. Created for each connection; passes what its peer says to the simulation as
//! events, and writes out what the simulation puts in its `Outbox`.
//!
//! Nothing piles up: a peer that talks faster than the simulation listens is sent away, and an actor whose
//! peer does not read is not run at all, so the simulation sees its outbox fill up. (To make the actor wait
//! until the simulation has listened would not do: what the peer says then piles up below the actor.)

use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use actix::{Actor, ActorContext as _, AsyncContext as _, Handler, Message, Recipient, StreamHandler};
use actix_web_actors::ws;
use bytestring::ByteString;

/// Texts of a peer that the simulation has not heard yet, at most.
const MOST_UNHEARD: usize = 256;

/// Tells connections apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ClientId(u64);

/// A text to write out, or the end.
#[derive(Message)]
#[rtype(result = "()")]
enum Outgoing {
    Text(ByteString),
    Close(ws::CloseCode),
}

/// What happens on a connection.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) enum Event {
    /// It was opened; here is how to write to it.
    Joined(ClientId, Outbox),
    /// Its peer said something.
    Said(ClientId, ByteString, Unheard),
    /// It is closed.
    Left(ClientId),
}

/// Counts a text as not heard yet, until it is dropped.
pub(crate) struct Unheard(Arc<AtomicUsize>);

/// The way to a client's peer.
#[derive(Clone)]
pub(crate) struct Outbox {
    client: Recipient<Outgoing>,
    /// Bytes that wait for the peer.
    waiting: Arc<AtomicUsize>,
    connection: Arc<TcpStream>,
}

impl Outbox {
    /// Queues a text, however much waits already.
    pub(crate) fn send(&self, text: ByteString) {
        self.waiting.fetch_add(cost(&text), Ordering::Relaxed);
        self.client.do_send(Outgoing::Text(text));
    }

    /// How many bytes of memory hold what waits for the peer to read.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Relaxed)
    }

    /// Says goodbye after all that waits.
    pub(crate) fn close(&self, code: ws::CloseCode) {
        self.client.do_send(Outgoing::Close(code));
    }

    /// Breaks the connection at once. The only way with a peer that does not read, since its actor is
    /// not run.
    pub(crate) fn hang_up(&self) {
        // it fails only if the connection is gone already
        drop(self.connection.shutdown(Shutdown::Both));
    }
}

impl Unheard {
    fn new(count: &Arc<AtomicUsize>) -> Self {
        count.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(count))
    }
}

impl Drop for Unheard {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A queued text takes about this much memory, even a short one.
fn cost(text: &ByteString) -> usize {
    text.len() + 128
}

/// The actor of one WebSocket.
pub(crate) struct Client {
    id: ClientId,
    simulation: Recipient<Event>,
    unheard: Arc<AtomicUsize>,
    waiting: Arc<AtomicUsize>,
    connection: Arc<TcpStream>,
}

impl Client {
    /// A client whose events go to `simulation`; `connection` is the one below the WebSocket.
    pub(crate) fn new(simulation: Recipient<Event>, connection: Arc<TcpStream>) -> Self {
        static NEXT_ID: AtomicU64 = AtomicU64::new(1);
        let id = ClientId(NEXT_ID.fetch_add(1, Ordering::Relaxed));
        Self { id, simulation, unheard: Arc::default(), waiting: Arc::default(), connection }
    }

    fn pass_on(&self, text: ByteString, ctx: &mut ws::WebsocketContext<Self>) {
        if self.unheard.load(Ordering::Relaxed) >= MOST_UNHEARD {
            Self::end(ctx, Some(ws::CloseCode::Policy.into()));
            return;
        }
        let unheard = Unheard::new(&self.unheard);
        self.simulation.do_send(Event::Said(self.id, text, unheard));
    }

    fn end(ctx: &mut ws::WebsocketContext<Self>, reason: Option<ws::CloseReason>) {
        ctx.close(reason);
        ctx.stop();
    }
}

impl Actor for Client {
    type Context = ws::WebsocketContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let outbox = Outbox {
            client: ctx.address().recipient(),
            waiting: Arc::clone(&self.waiting),
            connection: Arc::clone(&self.connection),
        };
        self.simulation.do_send(Event::Joined(self.id, outbox));
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        self.simulation.do_send(Event::Left(self.id));
    }
}

impl StreamHandler<Result<ws::Message, ws::ProtocolError>> for Client {
    fn handle(&mut self, message: Result<ws::Message, ws::ProtocolError>, ctx: &mut Self::Context) {
        match message {
            Ok(ws::Message::Text(text)) => self.pass_on(text, ctx),
            Ok(ws::Message::Ping(data)) => ctx.pong(&data),
            Ok(ws::Message::Pong(_) | ws::Message::Nop) => (),
            Ok(ws::Message::Close(reason)) => Self::end(ctx, reason),
            Ok(ws::Message::Binary(_) | ws::Message::Continuation(_)) => {
                Self::end(ctx, Some(ws::CloseCode::Unsupported.into()));
            }
            Err(_) => Self::end(ctx, Some(ws::CloseCode::Protocol.into())),
        }
    }
}

impl Handler<Outgoing> for Client {
    type Result = ();

    fn handle(&mut self, message: Outgoing, ctx: &mut Self::Context) {
        match message {
            Outgoing::Text(text) => {
                self.waiting.fetch_sub(cost(&text), Ordering::Relaxed);
                ctx.text(text);
            }
            Outgoing::Close(code) => Self::end(ctx, Some(code.into())),
        }
    }
}
