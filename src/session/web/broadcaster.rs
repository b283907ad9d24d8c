//! Actor: sends updates to the web clients of one worker thread.
//!
//! Created by the app in each thread that serves connections; it lasts as long as that. The registry sends each update
//! once to each broadcaster. Were it to send it to ten thousand clients itself, it would not answer requests meanwhile,
//! and each client would be woken from another thread, which takes a lock. After a panic of the broadcaster its clients'
//! connections are closed; those who connect next get a new broadcaster.

use std::cell::RefCell;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;

use crate::session::fleet::Subscribe;
use crate::session::fleet::{Subscribers, Update};
use crate::session::state::AppState;
use crate::shared::run::closing;

/// Asks for an update now, and for all that follow.
#[derive(Message)]
#[rtype(result = "Subscription")]
pub struct SubscribeClient(pub Recipient<Update>);

/// A client's subscription. Dropping it ends it.
#[derive(Debug)]
pub struct Subscription {
    id: u64,
    broadcaster: Addr<Broadcaster>,
}

#[derive(Message)]
#[rtype(result = "()")]
struct Unsubscribe(u64);

/// The actor.
pub struct Broadcaster {
    server: Arc<AppState>,
    clients: Subscribers,
    current: Option<Update>,
}

/// Time between two tries to reach clients whose mailboxes were full.
const RETRY: Duration = Duration::from_millis(250);
/// How many clients get an update at a time. They write it to their sockets before the next ones get it, so that what
/// each needs for that is still in the processor's cache.
const BATCH: usize = 32;
/// How many clients may subscribe in the same moment without waiting.
const MAILBOX: usize = 4096;

impl Broadcaster {
    /// A broadcaster without clients.
    #[must_use]
    pub fn new(server: Arc<AppState>) -> Self {
        Self { server, clients: Subscribers::default(), current: None }
    }

    fn send(&mut self, update: Update, ctx: &mut Context<Self>) {
        // There are no more updates once the server stops.
        if self.current != Some(Update::Closing) {
            self.current = Some(update);
            self.send_from(0, ctx);
        }
    }

    /// Sends the current update to the clients, one batch after another.
    fn send_from(&mut self, id: u64, ctx: &mut Context<Self>) {
        let Some(current) = self.current else { return };
        if let Some(next) = self.clients.send_batch(id, BATCH, current) {
            let turn = tokio::task::yield_now().into_actor(self);
            turn.map(move |(), broadcaster, ctx| broadcaster.send_from(next, ctx)).spawn(ctx);
        }
    }
}

/// The broadcaster of this thread.
pub struct LocalBroadcaster {
    server: Arc<AppState>,
    broadcaster: RefCell<Addr<Broadcaster>>,
}

impl LocalBroadcaster {
    /// Starts a broadcaster in this thread.
    #[must_use]
    pub fn start(server: Arc<AppState>) -> Self {
        let broadcaster = Broadcaster::new(Arc::clone(&server)).start();
        Self { server, broadcaster: RefCell::new(broadcaster) }
    }

    /// Returns the broadcaster, a new one if it has panicked.
    #[must_use]
    pub fn get(&self) -> Addr<Broadcaster> {
        let mut broadcaster = self.broadcaster.borrow_mut();
        if !broadcaster.connected() {
            log::error!("a broadcaster is gone, a new one is started");
            *broadcaster = Broadcaster::new(Arc::clone(&self.server)).start();
        }
        broadcaster.clone()
    }
}

impl Actor for Broadcaster {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.set_mailbox_capacity(MAILBOX);
        self.server.registry.do_send(Subscribe(ctx.address().recipient()));
        let ending = closing(self.server.phase.clone()).into_actor(self);
        ending.map(|(), broadcaster, ctx| broadcaster.send(Update::Closing, ctx)).spawn(ctx);
        ctx.run_interval(RETRY, |broadcaster, _| {
            if let Some(current) = broadcaster.current {
                broadcaster.clients.retry(current);
            }
        });
    }
}

impl Handler<Update> for Broadcaster {
    type Result = ();

    fn handle(&mut self, update: Update, ctx: &mut Self::Context) {
        self.send(update, ctx);
    }
}

impl Handler<SubscribeClient> for Broadcaster {
    type Result = MessageResult<SubscribeClient>;

    fn handle(&mut self, SubscribeClient(client): SubscribeClient, ctx: &mut Self::Context) -> Self::Result {
        let id = self.clients.add(client, self.current);
        MessageResult(Subscription { id, broadcaster: ctx.address() })
    }
}

impl Handler<Unsubscribe> for Broadcaster {
    type Result = ();

    fn handle(&mut self, Unsubscribe(id): Unsubscribe, _: &mut Self::Context) {
        self.clients.remove(id);
    }
}

impl Drop for Broadcaster {
    fn drop(&mut self) {
        // Clients that are closing anyway need not be told.
        if self.current != Some(Update::Closing) {
            self.clients.send(Update::Lost);
        }
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.broadcaster.do_send(Unsubscribe(self.id));
    }
}
