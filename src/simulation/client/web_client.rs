//! Actor: one WebSocket on `/client`. It parses its client's messages, and sends it the messages of the simulation's
//! session.
//!
//! Created by the route for each connection; ends with it. The simulation depends on the connection: the [`Session`]
//! that it is attached to is notified of its end, also after a panic.

use std::sync::Arc;

use actix::prelude::*;
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext};

use super::session::Session;
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::wrong_message;
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::closing;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::protocol::{self, ClientRequest};
use crate::simulation::sessions::{Attachment, ClientAction, Resume, ToClient, Token};
use crate::simulation::state::AppState;

/// The actor.
pub struct WebClient {
    server: Arc<AppState>,
    peer: Peer,
    /// The user name that a trusted reverse proxy sends.
    user: Option<String>,
    session: Attached,
    liveness: Liveness,
    _permit: ConnectionPermit,
}

/// Whether the client has a session.
enum Attached {
    /// It has not requested one yet.
    No,
    /// It has requested to resume one, and waits for the answer.
    Resuming,
    /// It has one.
    To(Attachment),
    /// It got its last text.
    Over,
}

/// Limit of texts that wait for a slow client, from which on optional texts are dropped.
const MAILBOX: usize = 64;

type Context = WebsocketContext<WebClient>;

impl WebClient {
    /// A client that has just connected; `permit` counts it.
    pub fn new(server: Arc<AppState>, (peer, user): (Peer, Option<String>), permit: ConnectionPermit) -> Self {
        Self { server, peer, user, session: Attached::No, liveness: Liveness::default(), _permit: permit }
    }

    fn finish(&mut self, last_words: String, code: CloseCode, ctx: &mut Context) {
        self.session = Attached::Over;
        ctx.text(last_words);
        ctx.close(Some(CloseReason { code, description: None }));
        ctx.stop();
    }

    /// Ends the simulation of a client that closes its connection regularly, or violates the protocol.
    fn leave(&self) {
        if let Attached::To(session) = &self.session {
            session.send(ClientAction::Leave);
        }
    }

    /// Requests from the session of a token to continue with this connection.
    fn resume(&mut self, token: &str, ctx: &mut Context) {
        let found = Token::parse(token).and_then(|token| Some((token, self.server.sessions.find(&token)?)));
        let Some((token, session)) = found else {
            log::info!("client {}: comes back to a simulation that has ended", self.peer);
            return self.finish(protocol::ended(None), CloseCode::Normal, ctx);
        };
        self.session = Attached::Resuming;
        let resumed = session.send(Resume { token, client: ctx.address().recipient(), peer: self.peer });
        resumed
            .into_actor(self)
            .map(|answer, this, ctx| match answer {
                Ok(Ok(())) => {}
                Ok(Err(refusal)) => {
                    log::info!("client {}: does not come back: {refusal}", this.peer);
                    this.finish(refusal, CloseCode::Normal, ctx);
                }
                Err(_) => this.finish(protocol::ended(None), CloseCode::Normal, ctx),
            })
            .spawn(ctx);
    }

    fn handle_request(&mut self, text: &str, ctx: &mut Context) {
        let request = match ClientRequest::parse(text) {
            Ok(request) => request,
            Err(wrong) => {
                log::info!("client {}: {wrong}", self.peer);
                self.leave();
                return self.finish(protocol::error(&wrong.to_string()), CloseCode::Normal, ctx);
            }
        };
        match (request, &self.session) {
            (ClientRequest { reset_controller: Some(file), .. }, Attached::To(session)) => {
                session.send(ClientAction::ResetController(file));
            }
            (ClientRequest { reset_controller: Some(_), .. }, _) => ctx.text(protocol::nothing_to_reset()),
            (ClientRequest { resume: Some(token), .. }, Attached::No) => self.resume(&token, ctx),
            (ClientRequest { keep: true, .. }, Attached::To(session)) => session.send(ClientAction::Keep),
            (ClientRequest { start: Some(start), .. }, Attached::No) => {
                let identity = ClientIdentity::new(self.user.as_deref(), start.name.as_deref());
                let (server, client) = (Arc::clone(&self.server), ctx.address().recipient());
                self.session = Attached::To(Session::open(server, (self.peer, identity), client, &start));
            }
            _ => log::info!(
                "client {}: a message that asks for nothing, or for a second simulation on one connection; ignored",
                self.peer
            ),
        }
    }
}

impl Actor for WebClient {
    type Context = Context;

    fn started(&mut self, ctx: &mut Self::Context) {
        log::info!("client {}: connected", self.peer);
        ctx.set_mailbox_capacity(MAILBOX);
        let timing = &self.server.config.timing;
        liveness::watch(ctx, timing.ping, timing.silence, |client| &mut client.liveness);
        closing(self.server.phase.clone())
            .into_actor(self)
            .map(|(), this, ctx| {
                // A client with a session is notified by its session.
                if matches!(this.session, Attached::No | Attached::Resuming) {
                    this.finish(protocol::stopping(), CloseCode::Away, ctx);
                }
            })
            .spawn(ctx);
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        log::info!("client {}: disconnected", self.peer);
    }
}

impl StreamHandler<Result<Message, ProtocolError>> for WebClient {
    fn handle(&mut self, message: Result<Message, ProtocolError>, ctx: &mut Self::Context) {
        match message {
            Ok(Message::Text(text)) if self.liveness.may_answer() => self.handle_request(&text, ctx),
            Ok(Message::Ping(data)) if self.liveness.may_answer() => ctx.pong(&data),
            Ok(Message::Pong(content)) => self.liveness.pong(&content),
            Ok(Message::Close(reason)) => {
                // After any other close code, or none, the client may return.
                if reason.as_ref().is_some_and(|reason| reason.code == CloseCode::Normal) {
                    self.leave();
                }
                ctx.close(reason);
                ctx.stop();
            }
            Ok(Message::Text(_) | Message::Ping(_)) => {
                log::warn!("client {}: asks too much between two pings", self.peer);
                self.leave();
                self.finish(protocol::error("Too many requests on one connection"), CloseCode::Policy, ctx);
            }
            other => {
                let (problem, code) = wrong_message(other);
                log::info!("client {}: {problem}", self.peer);
                self.leave();
                self.finish(protocol::error(&problem), code, ctx);
            }
        }
    }
}

impl Handler<ToClient> for WebClient {
    type Result = ();

    fn handle(&mut self, message: ToClient, ctx: &mut Self::Context) {
        match message {
            ToClient::Attached(session) => self.session = Attached::To(session),
            ToClient::Text(text) => ctx.text(text),
            ToClient::End(last_words, code) => self.finish(last_words, code, ctx),
        }
    }
}
