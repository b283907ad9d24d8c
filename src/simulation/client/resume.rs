//! How a session waits for its client, and continues with the client's next connection.

use actix::prelude::*;
use futures_util::stream::{self, StreamExt};

use super::session::{
    Absence, Attachment, Client, Comeback, LaunchedSimulation, ReadySimulation, Session, State, seconds_until,
};
use crate::shared::domain::Failure;
use crate::shared::run::seconds_since_1970;
use crate::simulation::attachment::{ClientAction, Connection, Resume, ToClient, Token};
use crate::simulation::ends::StopReason;
use crate::simulation::protocol;

impl Session {
    /// Waits for a client that may return; ends the session if it can't be resumed.
    pub(super) fn await_client(&mut self, ctx: &mut Context<Self>) {
        let (peer, token) = match self.client {
            Client::Connected(Attachment {
                peer,
                comeback: Comeback::With(token),
                ..
            }) => (peer, token),
            Client::Away(_) => return,
            Client::Connected(_) | Client::Expected(_) => return self.leave(StopReason::Left, ctx),
        };
        let absence = self.server.config.timing.absence;
        if !matches!(self.state, State::Over(_)) {
            log::info!("{}: away; it may come back within {} s", self.name(), absence.as_secs());
            self.show_away(Some(seconds_since_1970() + absence.as_secs()));
        }
        let timer = ctx.run_later(absence, |this, ctx| this.leave(StopReason::Away, ctx));
        self.client = Client::Away(Absence { peer, token, timer });
    }

    fn show_away(&self, until: Option<u64>) {
        self.server.slots.mark_away(self.id, until);
    }

    /// Attaches a connection to a session.
    pub(super) fn attached(connection: Connection, comeback: Comeback, ctx: &mut Context<Self>) -> Attachment {
        let Connection {
            peer,
            client,
            mut actions,
        } = connection;
        let actions = stream::poll_fn(move |context| actions.poll_recv(context));
        let (actions, handle) = stream::abortable(actions.chain(stream::iter([ClientAction::Disconnect])));
        ctx.add_stream(actions);
        Attachment {
            peer,
            comeback,
            client,
            actions: handle,
        }
    }

    /// Sends the client the kind of the scene, the URL of Webots and, if the client may come back, the token for that.
    pub(super) fn offer(&self) {
        let State::Ready(ReadySimulation { launched, url, .. }) = &self.state else {
            return;
        };
        if let Some(scene) = launched.scene {
            self.text(protocol::kind(scene));
        }
        self.text(protocol::webots(url));
        self.offer_comeback();
    }

    /// Sends the client the token with which it may come back, if it has one.
    pub(super) fn offer_comeback(&self) {
        if let Some(token) = self.token() {
            self.text(protocol::absence(self.server.config.timing.absence.as_secs()));
            self.text(protocol::resume(&token));
        }
    }

    /// The token with which the client comes back, if it has one.
    fn token(&self) -> Option<Token> {
        match self.client {
            Client::Connected(Attachment {
                comeback: Comeback::With(token),
                ..
            })
            | Client::Away(Absence { token, .. }) => Some(token),
            Client::Connected(_) | Client::Expected(_) => None,
        }
    }

    /// Why a client with this token may not return; `None` if it may.
    fn refusal(&self, token: Token) -> Option<Failure> {
        match &self.state {
            _ if self.token() != Some(token) => Some(protocol::taken_over()),
            State::Over(failure) => Some(protocol::ended(Some(failure))),
            _ => None,
        }
    }

    /// Tells a client that has come back what it has missed.
    pub(super) fn tell_again(&self) {
        self.text(protocol::simulation_id(self.id));
        match &self.state {
            State::Waiting { ahead, .. } => {
                self.offer_comeback();
                self.texts(ahead.iter().copied().flat_map(protocol::queue));
            }
            State::CheckingOut { progress, .. } => {
                self.offer_comeback();
                self.texts(progress.iter().flatten().cloned());
            }
            State::Launching { launched, progress } => {
                self.offer_comeback();
                self.tell_launched(launched);
                self.texts(progress.iter().cloned());
            }
            State::Ready(ready) => {
                self.tell_launched(&ready.launched);
                self.offer();
                if let Some(end) = ready.idle_end {
                    self.text(protocol::idle(Some(seconds_until(end))));
                }
                if ready.is_watched {
                    self.text(protocol::watched(true));
                }
            }
            State::Over(_) => {}
        }
    }

    /// Sends the rest of the time limit, and what the project requests.
    fn tell_launched(&self, launched: &LaunchedSimulation) {
        if let Some(started) = launched.started {
            let rest = self.server.config.timeout.saturating_sub(started.elapsed().as_secs());
            self.text(protocol::shutdown_timeout(rest));
        }
        self.texts(launched.texts.iter().cloned());
    }
}

impl Handler<Resume> for Session {
    type Result = ();

    fn handle(&mut self, Resume { token, connection }: Resume, ctx: &mut Self::Context) {
        let peer = connection.peer;
        if let Some(refusal) = self.refusal(token) {
            log::info!("{}: client {peer} does not come back: {refusal}", self.name());
            return connection.client.do_send(ToClient::Close(refusal));
        }
        log::info!("{}: goes on as client {peer}", self.name());
        let attached = Self::attached(connection, Comeback::With(token.next()), ctx);
        match std::mem::replace(&mut self.client, Client::Connected(attached)) {
            Client::Connected(before) => before.client.do_send(ToClient::Close(protocol::taken_over())),
            Client::Away(Absence { timer, .. }) => {
                ctx.cancel_future(timer);
            }
            // It has no token before it has a client.
            Client::Expected(_) => {}
        }
        self.show_away(None);
        self.await_viewer_again(ctx);
        self.tell_again();
    }
}
