//! The actor of one WebSocket. Created for each connection; passes what its peer says to the simulation
//! as events, one at a time, and writes out what the simulation puts in its `Outbox`.
//!
//! Nothing piles up: the next text of the peer waits until the simulation has handled the last, and an
//! actor whose peer does not read is not run at all, so the simulation sees its outbox fill up.

use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use actix::{
    Actor, ActorContext as _, ActorFutureExt as _, AsyncContext as _, ContextFutureSpawner as _,
    Handler, Message, Recipient, StreamHandler, WrapFuture as _,
};
use actix_web_actors::ws;
use bytestring::ByteString;

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
    Said(ClientId, ByteString),
    /// It is closed.
    Left(ClientId),
}

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
        self.waiting.fetch_add(text.len(), Ordering::Relaxed);
        self.client.do_send(Outgoing::Text(text));
    }

    /// How many bytes wait for the peer to read.
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

/// The actor of one WebSocket.
pub(crate) struct Client {
    id: ClientId,
    simulation: Recipient<Event>,
    waiting: Arc<AtomicUsize>,
    connection: Arc<TcpStream>,
}

impl Client {
    /// A client whose events go to `simulation`; `connection` is the one below the WebSocket.
    pub(crate) fn new(simulation: Recipient<Event>, connection: Arc<TcpStream>) -> Self {
        static NEXT_ID: AtomicU64 = AtomicU64::new(1);
        let id = ClientId(NEXT_ID.fetch_add(1, Ordering::Relaxed));
        Self {
            id,
            simulation,
            waiting: Arc::default(),
            connection,
        }
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
            Ok(ws::Message::Text(text)) => {
                let told = self.simulation.send(Event::Said(self.id, text));
                // waiting for the answer is what slows down a peer that says too much
                told.into_actor(self).map(|_, _, _| ()).wait(ctx);
            }
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
                self.waiting.fetch_sub(text.len(), Ordering::Relaxed);
                ctx.text(text);
            }
            Outgoing::Close(code) => Self::end(ctx, Some(code.into())),
        }
    }
}
