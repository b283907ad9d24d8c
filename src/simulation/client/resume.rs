//! How a session waits for its client, and continues with the client's next connection.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

use super::session::Session;
use crate::shared::http::Peer;
use crate::shared::run::seconds_since_1970;
use crate::simulation::protocol;
use crate::simulation::sessions::{Attachment, Resume, ToClient};
use crate::simulation::slots;

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
