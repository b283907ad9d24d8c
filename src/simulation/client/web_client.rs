//! Actor: one WebSocket on `/client`. It parses its client's messages, and sends the client the messages of its
//! session.
//!
//! Created by the route for each connection; ends with it. The [`Session`] to which it is attached is notified of its
//! end, also after a panic.

use std::sync::Arc;

use actix::prelude::*;
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

use super::session::Session;
use crate::shared::domain::{Failure, Reason};
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::wrong_message;
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::closing;
use crate::simulation::attachment::{ClientAction, Connection, Resume, ToClient, Token};
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::lost;
use crate::simulation::protocol::{self, ClientRequest};
use crate::simulation::state::AppState;

/// The actor.
pub struct WebClient {
    server: Arc<AppState>,
    peer: Peer,
    /// The user name that a trusted reverse proxy sends.
    user: Option<String>,
    /// Sends the client's actions to its session, once it has one.
    session: Option<UnboundedSender<ClientAction>>,
    liveness: Liveness,
    _permit: ConnectionPermit,
}

/// Number of texts queued for a slow client above which optional texts are dropped.
const MAILBOX: usize = 64;

type Context = WebsocketContext<WebClient>;

impl WebClient {
    /// A client that has just connected; `permit` counts it.
    pub fn new(server: Arc<AppState>, (peer, user): (Peer, Option<String>), permit: ConnectionPermit) -> Self {
        Self {
            server,
            peer,
            user,
            session: None,
            liveness: Liveness::default(),
            _permit: permit,
        }
    }

    /// Sends the client why there is nothing more to come, and closes the connection.
    fn finish(failure: &Failure, code: CloseCode, ctx: &mut Context) {
        for text in protocol::failure(failure) {
            ctx.text(text);
        }
        ctx.close(Some(CloseReason {
            code,
            description: None,
        }));
        ctx.stop();
    }

    /// Ends the connection and its simulation because of what the client has sent.
    fn reject(&self, problem: &Failure, code: CloseCode, ctx: &mut Context) {
        log::info!("client {}: {problem}", self.peer);
        self.send(ClientAction::Leave);
        Self::finish(problem, code, ctx);
    }

    /// Sends an action to the client's session, if there is one.
    fn send(&self, action: ClientAction) {
        if let Some(session) = &self.session {
            // A session that has ended has notified its client.
            session.send(action).ok();
        }
    }

    /// Attaches this connection to a session. The client gets `end` if the session drops the connection without one.
    fn attach(&mut self, end: Failure, ctx: &mut Context) -> Connection {
        let (session, actions) = unbounded_channel();
        let attached = session.clone();
        // The session's earlier texts come first; after an end from the session, this actor has stopped.
        let gone = async move { attached.closed().await };
        gone.into_actor(self)
            .map(move |(), _, ctx| ctx.address().do_send(ToClient::Close(end)))
            .spawn(ctx);
        self.session = Some(session);
        Connection {
            peer: self.peer,
            client: ctx.address().recipient(),
            actions,
        }
    }

    /// Asks the session of a token to continue with this connection.
    fn resume(&mut self, token: &str, ctx: &mut Context) {
        // Also sent if the session ends before it reads the request.
        let ended = protocol::ended(None);
        let found = Token::parse(token).and_then(|token| Some((token, self.server.sessions.find(token)?)));
        let Some((token, session)) = found else {
            log::info!("client {}: comes back to a simulation that has ended", self.peer);
            return Self::finish(&ended, protocol::close_code(ended.reason), ctx);
        };
        session.do_send(Resume {
            token,
            connection: self.attach(ended, ctx),
        });
    }

    fn handle_request(&mut self, text: &str, ctx: &mut Context) {
        let request = match ClientRequest::parse(text) {
            Ok(request) => request,
            Err(wrong) => return self.reject(&wrong.into(), CloseCode::Normal, ctx),
        };
        match (request, &self.session) {
            (ClientRequest::ResetController(file), Some(_)) => self.send(ClientAction::ResetController(file)),
            (ClientRequest::ResetController(_), None) => {
                for text in protocol::failure(&protocol::nothing_to_reset()) {
                    ctx.text(text);
                }
            }
            (ClientRequest::Resume(token), None) => self.resume(&token, ctx),
            (ClientRequest::Keep, Some(_)) => self.send(ClientAction::Keep),
            (ClientRequest::Start(start), None) => {
                let identity = ClientIdentity::new(self.user.clone(), start.name.as_deref());
                // Sent only if the session panics: otherwise it sends an end itself.
                let connection = self.attach(lost(), ctx);
                Session::open(&self.server, identity, connection, &start);
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
        closing(self.server.phase.subscribe())
            .into_actor(self)
            .map(|(), this, ctx| {
                // A client with a session is notified by its session.
                if this.session.is_none() {
                    Self::finish(&protocol::stopping(), CloseCode::Away, ctx);
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
                    self.send(ClientAction::Leave);
                }
                ctx.close(reason);
                ctx.stop();
            }
            Ok(Message::Text(_) | Message::Ping(_)) => {
                let message = "Too many requests on one connection";
                let problem = Failure::new(Reason::TooManyRequests, message);
                self.reject(&problem, CloseCode::Policy, ctx);
            }
            other => {
                let (problem, code) = wrong_message(other);
                self.reject(&Failure::new(Reason::InvalidRequest, problem), code, ctx);
            }
        }
    }
}

impl Handler<ToClient> for WebClient {
    type Result = ();

    fn handle(&mut self, message: ToClient, ctx: &mut Self::Context) {
        match message {
            ToClient::Text(text) => ctx.text(text),
            ToClient::Close(failure) => Self::finish(&failure, protocol::close_code(failure.reason), ctx),
        }
    }
}
