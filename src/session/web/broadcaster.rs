//! Actor: the web clients of one worker thread, and what they are to be told.
//!
//! Created by the app in each thread that serves connections; it lasts as long as that. The registry tells it of a
//! change once, and it tells its clients: from thread to thread each of ten thousand would be woken with a lock, and the
//! registry would be busy with that instead of with requests. After a panic its clients are sent away, and find another
//! one when they come back.

use std::cell::RefCell;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;

use crate::session::fleet::Subscribe;
use crate::session::fleet::{News, Subscribers};
use crate::session::state::AppState;
use crate::shared::run::closing;

/// Asks to be told the news, now and whenever there are others.
#[derive(Message)]
#[rtype(result = "Membership")]
pub struct Join(pub Recipient<News>);

/// A place in the audience. Dropping it gives it up.
#[derive(Debug)]
pub struct Membership {
    id: u64,
    audience: Addr<Audience>,
}

#[derive(Message)]
#[rtype(result = "()")]
struct Leave(u64);

/// The actor.
pub struct Audience {
    server: Arc<AppState>,
    clients: Subscribers,
    news: Option<News>,
}

/// Between two tries to tell a client whose mailbox was full.
const AGAIN: Duration = Duration::from_millis(250);
/// So many clients are told at a time, and then write before others are told: what a client needs for that is then still
/// in the processor's cache.
const BATCH: usize = 32;
/// How many clients may join in one moment; more wait outside.
const CROWD: usize = 4096;

impl Audience {
    /// An audience without clients.
    #[must_use]
    pub fn new(server: Arc<AppState>) -> Self {
        Self { server, clients: Subscribers::default(), news: None }
    }

    fn tell(&mut self, news: News, ctx: &mut Context<Self>) {
        // Nothing is news any more once the server ends.
        if self.news != Some(News::Closing) {
            self.news = Some(news);
            self.tell_from(0, ctx);
        }
    }

    /// Tells the newest, a batch at a time.
    fn tell_from(&mut self, id: u64, ctx: &mut Context<Self>) {
        let Some(news) = self.news else { return };
        if let Some(next) = self.clients.tell_some(id, BATCH, news) {
            let turn = tokio::task::yield_now().into_actor(self);
            turn.map(move |(), audience, ctx| audience.tell_from(next, ctx)).spawn(ctx);
        }
    }
}

/// The audience of this thread.
pub struct CurrentAudience {
    server: Arc<AppState>,
    audience: RefCell<Addr<Audience>>,
}

impl CurrentAudience {
    /// Starts the first one.
    #[must_use]
    pub fn start(server: Arc<AppState>) -> Self {
        let audience = Audience::new(Arc::clone(&server)).start();
        Self { server, audience: RefCell::new(audience) }
    }

    /// The one to join, or a new one if it has panicked.
    #[must_use]
    pub fn get(&self) -> Addr<Audience> {
        let mut audience = self.audience.borrow_mut();
        if !audience.connected() {
            log::error!("an audience is gone, a new one is started");
            *audience = Audience::new(Arc::clone(&self.server)).start();
        }
        audience.clone()
    }
}

impl Actor for Audience {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.set_mailbox_capacity(CROWD);
        self.server.registry.do_send(Subscribe(ctx.address().recipient()));
        let ending = closing(self.server.phase.clone()).into_actor(self);
        ending.map(|(), audience, ctx| audience.tell(News::Closing, ctx)).spawn(ctx);
        ctx.run_interval(AGAIN, |audience, _| {
            if let Some(news) = audience.news {
                audience.clients.tell_late(news);
            }
        });
    }
}

impl Handler<News> for Audience {
    type Result = ();

    fn handle(&mut self, news: News, ctx: &mut Self::Context) {
        self.tell(news, ctx);
    }
}

impl Handler<Join> for Audience {
    type Result = MessageResult<Join>;

    fn handle(&mut self, Join(client): Join, ctx: &mut Self::Context) -> Self::Result {
        let id = self.clients.add(client, self.news);
        MessageResult(Membership { id, audience: ctx.address() })
    }
}

impl Handler<Leave> for Audience {
    type Result = ();

    fn handle(&mut self, Leave(id): Leave, _: &mut Self::Context) {
        self.clients.remove(id);
    }
}

impl Drop for Audience {
    fn drop(&mut self) {
        // Nothing is news any more once the server ends.
        if self.news != Some(News::Closing) {
            self.clients.tell(News::Lost);
        }
    }
}

impl Drop for Membership {
    fn drop(&mut self) {
        self.audience.do_send(Leave(self.id));
    }
}
