//! Actor: the WebSocket of one web client, which receives the fleet's availability and requests simulation servers.
//!
//! Created by the route for each connection; ends with it. It sends the fleet's availability when it changes: only the
//! latest value, and never the same twice in a row. A text from the client requests a simulation server, at once or when
//! it is its turn in the line.

use std::sync::Arc;

use actix::prelude::*;
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext};
use bytestring::ByteString;
use futures_util::StreamExt;
use futures_util::stream::{self, Stream};
use serde::Deserialize;
use serde_json::Value;
use tokio::sync::watch;

use super::refusal;
use crate::session::fleet::{LineEvent, LineNews, StopWaiting, Wait};
use crate::session::line::{Place, Position, Ticket};
use crate::session::state::{AppState, PLACED, read_world};
use crate::shared::domain::{Failure, Reason};
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::wrong_message;
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::{Phase, closing, milliseconds_since_1970};
use crate::shared::text::{chosen_name, client_text};

/// The actor.
pub struct WebClient {
    server: Arc<AppState>,
    peer: Peer,
    liveness: Liveness,
    /// Its user, if a trusted reverse proxy names one.
    user: Option<String>,
    /// Whether it has requested announcements.
    wants_announcements: bool,
    /// What it heard last of its place in the line, if it has one.
    waiting: Option<Waiting>,
    _permit: ConnectionPermit,
}

/// A client that waits in the line.
struct Waiting {
    /// Identifies this wait in the line.
    number: u64,
    /// The seconds until its turn, as last sent.
    estimate: Option<u32>,
    /// Whether it understands a text with the reason before that of an error.
    wants_reason: bool,
}

type Context = WebsocketContext<WebClient>;

impl WebClient {
    /// A client that has just connected; `permit` counts it.
    pub fn new(
        server: Arc<AppState>,
        (peer, user): (Peer, Option<String>),
        wants_announcements: bool,
        permit: ConnectionPermit,
    ) -> Self {
        Self {
            server,
            peer,
            user,
            liveness: Liveness::default(),
            wants_announcements,
            waiting: None,
            _permit: permit,
        }
    }

    fn close(code: CloseCode, ctx: &mut Context) {
        ctx.close(Some(CloseReason {
            code,
            description: None,
        }));
        ctx.stop();
    }

    fn handle_text(&mut self, text: &str, ctx: &mut Context) {
        match Request::parse(text) {
            Request::Pick(request) => self.pick(request, ctx),
            Request::Wait(request, ticket) => self.wait(&request, ticket.as_deref(), ctx),
            Request::StopWaiting => self.stop_waiting(),
        }
    }

    fn pick(&self, request: ServerRequest, ctx: &mut Context) {
        let server = Arc::clone(&self.server);
        let from = self.peer.rate_limit_key();
        let picked = async move {
            let picked = server.pick(request.world.as_deref(), from).await;
            (picked, request.wants_reason)
        };
        // The actor handles nothing else until then, so that answers keep the order of the texts and precede a close.
        picked
            .into_actor(self)
            .map(|(picked, wants_reason), _, ctx| match picked {
                Ok(url) => ctx.text(url),
                Err(failure) => Self::refuse(&failure, wants_reason, ctx),
            })
            .wait(ctx);
    }

    /// Enters the line. What happens there follows as messages.
    fn wait(&mut self, request: &ServerRequest, ticket: Option<&str>, ctx: &mut Context) {
        self.stop_waiting();
        let world = match read_world(request.world.as_deref().unwrap_or_default()) {
            Ok(world) => world,
            Err(failure) => return Self::refuse(&failure, request.wants_reason, ctx),
        };
        let number = rand::random();
        self.waiting = Some(Waiting {
            number,
            estimate: None,
            wants_reason: request.wants_reason,
        });
        let wait = Wait {
            world,
            ticket: ticket.and_then(|text| Ticket::read(text, &self.server.key, milliseconds_since_1970())),
            number,
            client: ctx.address().recipient(),
            from: self.peer.rate_limit_key(),
            user: self.user.clone(),
            label: request.name.clone(),
        };
        let wants_reason = request.wants_reason;
        let server = Arc::clone(&self.server);
        async move { server.wait(wait).await }
            .into_actor(self)
            .map(move |entered, client, ctx| match entered {
                Ok(Some(place)) => client.send_ticket(place, ctx),
                Ok(None) => {}
                Err(failure) => {
                    client.waiting = None;
                    Self::refuse(&failure, wants_reason, ctx);
                }
            })
            .wait(ctx);
    }

    /// Leaves the line, also if the registry has not answered yet: it handles what it was asked before first.
    fn stop_waiting(&mut self) {
        if let Some(waiting) = self.waiting.take() {
            self.server.registry.do_send(StopWaiting(waiting.number));
        }
    }

    fn send_ticket(&self, place: Place, ctx: &mut Context) {
        let ticket = Ticket {
            place,
            sent: milliseconds_since_1970(),
        };
        ctx.text(format!("ticket: {}", ticket.write(&self.server.key)));
    }

    fn refuse(failure: &Failure, wants_reason: bool, ctx: &mut Context) {
        if wants_reason {
            ctx.text(refusal::reason_text(failure.reason));
        }
        ctx.text(refusal::sentence(failure));
    }
}

/// What a client's text requests.
#[derive(Debug, PartialEq)]
enum Request {
    /// A simulation server now.
    Pick(ServerRequest),
    /// A simulation server when it is the client's turn; it may have a ticket.
    Wait(ServerRequest, Option<String>),
    /// To leave the line.
    StopWaiting,
}

/// A request for a simulation server.
#[derive(Debug, PartialEq)]
struct ServerRequest {
    /// The URL of its world, if it names one.
    world: Option<String>,
    /// Whether it understands a text with the reason before that of an error.
    wants_reason: bool,
    /// The name that the client has chosen, for administrators.
    name: Option<String>,
}

impl Request {
    /// Reads a URL, `{"url": ...}` or `{"wait": ...}`; anything else requests a server without naming a world.
    fn parse(text: &str) -> Self {
        #[derive(Deserialize)]
        struct Wanted {
            url: Option<Value>,
            #[serde(default)]
            reason: Value,
            #[serde(default)]
            wait: Value,
            #[serde(default)]
            ticket: Value,
            #[serde(default)]
            name: Value,
        }
        let text = text.trim();
        let Ok(wanted) = serde_json::from_str::<Wanted>(text) else {
            return Self::Pick(ServerRequest {
                world: text.contains("://").then(|| text.to_owned()),
                wants_reason: false,
                name: None,
            });
        };
        let url = wanted.url;
        let request = ServerRequest {
            world: url.map(|url| url.as_str().map_or_else(|| url.to_string(), str::to_owned)),
            wants_reason: wanted.reason == true,
            name: wanted.name.as_str().and_then(chosen_name),
        };
        match wanted.wait {
            Value::Bool(true) => Self::Wait(request, wanted.ticket.as_str().map(str::to_owned)),
            Value::Bool(false) if request.world.is_none() => Self::StopWaiting,
            _ => Self::Pick(request),
        }
    }
}

impl Actor for WebClient {
    type Context = Context;

    fn started(&mut self, ctx: &mut Self::Context) {
        let timing = &self.server.config.timing;
        liveness::watch(ctx, timing.ping, timing.silence, |client| &mut client.liveness);
        ctx.add_stream(updates(self.server.available.clone(), self.server.phase.clone()));
        if self.wants_announcements {
            ctx.add_stream(announcements(self.server.announcement.subscribe()));
        }
    }
}

impl Drop for WebClient {
    fn drop(&mut self) {
        self.stop_waiting();
    }
}

impl Handler<LineEvent> for WebClient {
    type Result = ();

    fn handle(&mut self, LineEvent { wait, news }: LineEvent, ctx: &mut Context) {
        // It has left the line meanwhile, or waits for something else.
        let Some(waiting) = self.waiting.as_mut().filter(|waiting| waiting.number == wait) else {
            return;
        };
        match news {
            LineNews::Ticket(place) => self.send_ticket(place, ctx),
            LineNews::Position(Position { ahead, estimate }) => {
                ctx.text(format!("queue: {ahead}"));
                if let Some(seconds) = estimate.filter(|_| waiting.estimate != estimate) {
                    ctx.text(format!("estimate: {seconds}"));
                }
                waiting.estimate = estimate;
            }
            LineNews::Turn(turn) => {
                if let Some(pass) = turn.pass {
                    ctx.text(format!("pass: {}", pass.write(&self.server.key, &turn.world)));
                }
                ctx.text(self.server.client_urls.websocket_url(&turn.server));
                self.server.picks.with_label_values(&[PLACED]).inc();
                self.waiting = None;
            }
            LineNews::TakenOver => {
                let words = "another connection has this place in the line";
                Self::refuse(&Failure::new(Reason::TakenOver, words), waiting.wants_reason, ctx);
                self.waiting = None;
            }
        }
    }
}

/// The current availability and its changes, never the same value twice in a row; then `None`, the stop of the server.
fn updates(
    mut available: watch::Receiver<bool>,
    phase: watch::Receiver<Phase>,
) -> impl Stream<Item = Option<ByteString>> {
    available.mark_changed();
    let changes = stream::unfold((available, None), async |(mut available, sent)| {
        loop {
            available.changed().await.ok()?;
            let now = *available.borrow_and_update();
            if sent != Some(now) {
                let text = ByteString::from_static(if now { "1" } else { "0" });
                return Some((Some(text), (available, Some(now))));
            }
        }
    });
    changes.take_until(Box::pin(closing(phase))).chain(stream::iter([None]))
}

/// The current announcement, if there is one, and each change; no text once it is over.
fn announcements(mut all: watch::Receiver<String>) -> impl Stream<Item = Option<ByteString>> {
    if !all.borrow().is_empty() {
        all.mark_changed();
    }
    stream::unfold(all, async |mut all| {
        all.changed().await.ok()?;
        let text = client_text(&all.borrow_and_update());
        Some((Some(format!("announcement: {text}").trim_end().into()), all))
    })
}

/// Texts to the web client that are not answers; `None` closes the connection.
impl StreamHandler<Option<ByteString>> for WebClient {
    fn handle(&mut self, text: Option<ByteString>, ctx: &mut Context) {
        match text {
            Some(text) => ctx.text(text),
            None => Self::close(CloseCode::Away, ctx),
        }
    }
}

impl StreamHandler<Result<Message, ProtocolError>> for WebClient {
    fn handle(&mut self, message: Result<Message, ProtocolError>, ctx: &mut Self::Context) {
        match message {
            Ok(Message::Text(text)) if self.liveness.may_answer() => self.handle_text(&text, ctx),
            Ok(Message::Ping(data)) if self.liveness.may_answer() => ctx.pong(&data),
            Ok(Message::Pong(content)) => self.liveness.pong(&content),
            Ok(Message::Close(reason)) => {
                ctx.close(reason);
                ctx.stop();
            }
            Ok(Message::Text(_) | Message::Ping(_)) => {
                log::warn!("client {}: asks too much between two pings", self.peer);
                ctx.text("Error: too many requests on one connection.");
                Self::close(CloseCode::Policy, ctx);
            }
            other => {
                let (problem, code) = wrong_message(other);
                log::debug!("client {}: {problem}", self.peer);
                Self::close(code, ctx);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pick(world: Option<&str>, wants_reason: bool) -> Request {
        Request::Pick(request(world, wants_reason))
    }

    fn request(world: Option<&str>, wants_reason: bool) -> ServerRequest {
        ServerRequest {
            world: world.map(str::to_owned),
            wants_reason,
            name: None,
        }
    }

    #[test]
    fn a_message_may_name_a_world() {
        let world = "https://github.com/u/r/blob/main/worlds/a.wbt";
        let table = [
            ("", None),
            ("please", None),
            (r#"{"other": 1}"#, None),
            (r#"{"url": 5}"#, Some("5")),
            (world, Some(world)),
            (&format!(r#"{{"url": "{world}"}}"#), Some(world)),
            ("http://no.world", Some("http://no.world")),
        ];
        for (text, expected) in table {
            assert_eq!(Request::parse(text), pick(expected, false), "{text:?}");
        }
    }

    #[test]
    fn only_a_client_that_asks_for_the_reason_gets_it() {
        for (text, expected) in [
            (r#"{"url": "x", "reason": true}"#, pick(Some("x"), true)),
            (r#"{"url": "x", "reason": false}"#, pick(Some("x"), false)),
            (r#"{"url": "x", "reason": "true"}"#, pick(Some("x"), false)),
            (r#"{"reason": true}"#, pick(None, true)),
        ] {
            assert_eq!(Request::parse(text), expected, "{text}");
        }
    }

    #[test]
    fn a_client_may_ask_to_wait() {
        let ticket = Some("abc".to_owned());
        for (text, expected) in [
            (
                r#"{"url": "x", "wait": true}"#,
                Request::Wait(request(Some("x"), false), None),
            ),
            (
                r#"{"url": "x", "wait": true, "ticket": "abc", "reason": true}"#,
                Request::Wait(request(Some("x"), true), ticket),
            ),
            (
                r#"{"url": "x", "wait": true, "ticket": 5}"#,
                Request::Wait(request(Some("x"), false), None),
            ),
            (r#"{"url": "x", "wait": "true"}"#, pick(Some("x"), false)),
            (r#"{"url": "x", "wait": false}"#, pick(Some("x"), false)),
            (r#"{"wait": false}"#, Request::StopWaiting),
            (r#"{"wait": true}"#, Request::Wait(request(None, false), None)),
        ] {
            assert_eq!(Request::parse(text), expected, "{text}");
        }
    }
}
