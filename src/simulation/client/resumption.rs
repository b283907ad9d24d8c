//! How a client comes back: what its session keeps for it, how long the session waits, and how it continues with the
//! client's next connection.

use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

use super::session::Session;
use crate::shared::http::Peer;
use crate::shared::run::seconds_since_1970;
use crate::simulation::protocol;
use crate::simulation::sessions::{Attachment, Resume, ToClient, Token};
use crate::simulation::slots;

/// What a session keeps for a client that returns.
#[derive(Default)]
pub(super) struct Resumption {
    /// The number under which the session is registered, if its client has requested a resumable simulation.
    pub(super) number: Option<u64>,
    /// The last token that the client got; `None` before it can return.
    token: Option<Token>,
    /// When Webots was started: the time limit starts then.
    pub(super) launched: Option<Instant>,
    /// The texts that its project requests.
    pub(super) texts: Vec<String>,
    url: String,
    /// When the simulation ends because it is paused, if it does.
    pub(super) idle_end: Option<Instant>,
    /// The timer that ends the wait for the client, if there is one.
    deadline: Option<SpawnHandle>,
    /// Why the simulation has ended, if it has.
    pub(super) ended: Option<String>,
}

/// How many seconds are left until then, rounded up.
pub(super) fn seconds_until(then: Instant) -> u64 {
    (then.saturating_duration_since(Instant::now()) + Duration::from_millis(999)).as_secs()
}

impl Resumption {
    /// Webots is ready at this URL: from now on the client may come back. Returns the texts that offer it.
    pub(super) fn offer(&mut self, url: String, absence: Duration) -> Option<[String; 2]> {
        self.url = url;
        let token = self.token.insert(Token::new(self.number?));
        Some([protocol::absence(absence.as_secs()), protocol::resume(token)])
    }

    /// Why a client with this token may not return, as text for it; `None` if it may.
    fn refusal(&self, token: &Token) -> Option<String> {
        match &self.token {
            None => Some(protocol::ended(None)),
            Some(own) if own != token => Some(protocol::taken_over()),
            Some(_) => self.ended.as_ref().map(|why| protocol::ended(Some(why))),
        }
    }

    /// The texts for a client that is back: those that it got before, and a new token.
    fn texts(&mut self, timeout: u64, absence: Duration) -> Vec<String> {
        let passed = self.launched.map_or(0, |launched| launched.elapsed().as_secs());
        let mut texts = vec![protocol::shutdown_timeout(timeout.saturating_sub(passed))];
        texts.extend(self.texts.iter().cloned());
        texts.push(protocol::webots(&self.url));
        texts.extend(self.offer(self.url.clone(), absence).into_iter().flatten());
        texts.extend(self.idle_end.map(|end| protocol::idle(Some(seconds_until(end)))));
        texts
    }
}

impl Session {
    /// Waits for a client that may return; ends the session if it can't be resumed.
    pub(super) fn await_client(&mut self, ctx: &mut Context<Self>) {
        let absence = self.server.config.timing.absence;
        if self.resumption.token.is_none() {
            return ctx.stop();
        }
        if self.resumption.deadline.is_some() {
            return;
        }
        if self.resumption.ended.is_none() {
            log::info!("{}: away; it may come back within {} s", self.name(), absence.as_secs());
            self.show_away(Some(seconds_since_1970() + absence.as_secs()));
        }
        self.resumption.deadline = Some(ctx.run_later(absence, move |this, ctx| {
            log::info!("{}: has not come back within {} s", this.name(), absence.as_secs());
            ctx.stop();
        }));
    }

    fn show_away(&self, until: Option<u64>) {
        if let Some(id) = self.id {
            slots::update(&self.server.slots, id, move |one| one.away_until = until);
        }
    }

    /// Continues with another connection of its client, and closes the one before.
    fn continue_with(&mut self, client: Recipient<ToClient>, peer: Peer, ctx: &mut Context<Self>) {
        log::info!("{}: goes on as client {peer}", self.name());
        self.peer = peer;
        self.attachment += 1;
        client.do_send(ToClient::Attached(Attachment::new(ctx.address().recipient(), self.attachment)));
        if let Some(before) = self.client.replace(client) {
            before.do_send(ToClient::End(protocol::taken_over(), CloseCode::Normal));
        }
        self.resumption.deadline.take().map(|deadline| ctx.cancel_future(deadline));
        self.show_away(None);
        let mut texts = Vec::from_iter(self.id.map(protocol::session));
        texts.extend(self.resumption.texts(self.server.config.timeout, self.server.config.timing.absence));
        if self.is_watched {
            texts.push(protocol::watched(true));
        }
        for text in texts {
            self.text(text);
        }
    }
}

impl Handler<Resume> for Session {
    type Result = Result<(), String>;

    fn handle(&mut self, Resume { token, client, peer }: Resume, ctx: &mut Self::Context) -> Self::Result {
        if let Some(refusal) = self.resumption.refusal(&token) {
            return Err(refusal);
        }
        self.continue_with(client, peer, ctx);
        Ok(())
    }
}
