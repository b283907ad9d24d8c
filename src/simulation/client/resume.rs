//! How a session waits for its client, and continues with the client's next connection.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

use super::session::Session;
use crate::shared::http::Peer;
use crate::simulation::protocol;
use crate::simulation::sessions::{Attachment, Resume, ToClient};

impl Session {
    /// Waits for a client that may return; ends the session if it can't be resumed.
    pub(super) fn await_client(&mut self, ctx: &mut Context<Self>) {
        let absence = self.server.config.timing.absence;
        let name = self.name();
        let Some(resumption) = self.resumption.as_mut().filter(|resumption| resumption.is_ready()) else {
            return ctx.stop();
        };
        if resumption.deadline.is_some() {
            return;
        }
        if resumption.away(absence) {
            log::info!("{name}: away; it may come back within {} s", absence.as_secs());
        }
        resumption.deadline = Some(ctx.run_later(absence, move |this, ctx| {
            log::info!("{}: has not come back within {} s", this.name(), absence.as_secs());
            ctx.stop();
        }));
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
        let (timeout, absence) = (self.server.config.timeout, self.server.config.timing.absence);
        let mut texts = Vec::new();
        if let Some(resumption) = &mut self.resumption {
            if let Some(deadline) = resumption.deadline.take() {
                ctx.cancel_future(deadline);
            }
            texts = resumption.back(timeout, absence);
        }
        if self.is_watched {
            texts.push(protocol::watched(true));
        }
        for text in texts {
            self.text(text);
        }
    }
}

impl Handler<Resume> for Session {
    type Result = ResponseActFuture<Self, Result<(), String>>;

    fn handle(&mut self, Resume { token, client, peer }: Resume, _: &mut Self::Context) -> Self::Result {
        let refused = |refusal| Box::pin(actix::fut::err(refusal));
        let Some(resumption) = &self.resumption else {
            return refused(protocol::ended(None));
        };
        if let Some(refusal) = resumption.refusal(&token) {
            return refused(refusal);
        }
        let moved = resumption.move_to(peer.rate_limit_key()).into_actor(self);
        Box::pin(moved.map(move |moved, this, ctx| {
            if let Ok(Err(full)) = moved {
                return Err(protocol::error(&full.to_string()));
            }
            // Another connection may have used the same token since then.
            if let Some((resumption, refusal)) =
                this.resumption.as_ref().and_then(|one| Some((one, one.refusal(&token)?)))
            {
                // The slot counts for the address of that connection.
                resumption.stay_at(this.peer.rate_limit_key());
                return Err(refusal);
            }
            this.continue_with(client, peer, ctx);
            Ok(())
        }))
    }
}
