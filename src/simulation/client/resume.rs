//! How a session waits for its client, and continues with the client's next connection.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;
use futures_util::stream::{self, StreamExt};

use super::session::{Session, seconds_until};
use crate::shared::run::seconds_since_1970;
use crate::simulation::protocol;
use crate::simulation::sessions::{ClientAction, Connection, Resume, ToClient, Token};

impl Session {
    /// Waits for a client that may return; ends the session if it can't be resumed.
    pub(super) fn await_client(&mut self, ctx: &mut Context<Self>) {
        let absence = self.server.config.timing.absence;
        if self.token.is_none() {
            return ctx.stop();
        }
        if self.deadline.is_some() {
            return;
        }
        if self.ended.is_none() {
            log::info!("{}: away; it may come back within {} s", self.name(), absence.as_secs());
            self.show_away(Some(seconds_since_1970() + absence.as_secs()));
        }
        self.deadline = Some(ctx.run_later(absence, |_, ctx| ctx.stop()));
    }

    fn show_away(&self, until: Option<u64>) {
        if let Some(id) = self.id {
            self.server.slots.update(id, |one| one.away_until = until);
        }
    }

    /// Switches the session to this connection: an earlier one is closed, and its actions are ignored.
    pub(super) fn attach(
        &mut self,
        Connection {
            peer,
            client,
            mut actions,
        }: Connection,
        ctx: &mut Context<Self>,
    ) {
        self.peer = peer;
        if let Some(before) = self.client.replace(client) {
            before.do_send(ToClient::End(protocol::taken_over(), CloseCode::Normal));
        }
        let actions = stream::poll_fn(move |context| actions.poll_recv(context));
        let (actions, attachment) = stream::abortable(actions.chain(stream::iter([ClientAction::Disconnect])));
        ctx.add_stream(actions);
        if let Some(before) = self.attachment.replace(attachment) {
            before.abort();
        }
    }

    /// Sends the client the kind of the scene, the URL of Webots and, if the session is resumable, a token to return with.
    pub(super) fn offer(&mut self, ctx: &mut Context<Self>) {
        let Some(url) = &self.url else { return };
        if let Some(kind) = self.kind {
            self.text(protocol::kind(kind).to_owned());
        }
        self.text(protocol::webots(url));
        if self.resumable {
            let register = || self.server.sessions.register(ctx.address().recipient());
            let token = self.token.map_or_else(register, Token::next);
            self.token = Some(token);
            self.text(protocol::absence(self.server.config.timing.absence.as_secs()));
            self.text(protocol::resume(&token));
        }
    }

    /// Why a client with this token may not return, as text for it; `None` if it may.
    fn refusal(&self, token: Token) -> Option<String> {
        if self.token != Some(token) {
            return Some(protocol::taken_over());
        }
        self.ended.as_ref().map(|why| protocol::ended(Some(why)))
    }
}

impl Handler<Resume> for Session {
    type Result = ();

    fn handle(&mut self, Resume { token, connection }: Resume, ctx: &mut Self::Context) {
        if let Some(refusal) = self.refusal(token) {
            log::info!(
                "{}: client {} does not come back: {refusal}",
                self.name(),
                connection.peer
            );
            return connection.client.do_send(ToClient::End(refusal, CloseCode::Normal));
        }
        log::info!("{}: goes on as client {}", self.name(), connection.peer);
        self.attach(connection, ctx);
        self.deadline.take().map(|deadline| ctx.cancel_future(deadline));
        self.show_away(None);
        self.id.into_iter().for_each(|id| self.text(protocol::session(id)));
        let passed = self.launched.map_or(0, |launched| launched.elapsed().as_secs());
        self.text(protocol::shutdown_timeout(
            self.server.config.timeout.saturating_sub(passed),
        ));
        self.texts.iter().for_each(|text| self.text(text.clone()));
        self.offer(ctx);
        if let Some(end) = self.idle_end {
            self.text(protocol::idle(Some(seconds_until(end))));
        }
        if self.is_watched {
            self.text(protocol::watched(true));
        }
    }
}
