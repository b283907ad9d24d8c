//! Actor: the WebSocket of one web client, which receives the fleet's availability and requests simulation servers.
//!
//! Created by the route for each connection; ends with it. It sends the fleet's availability when it changes: only the
//! latest value, and never the same twice in a row. A text from the client requests a simulation server.

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
use crate::session::state::AppState;
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::wrong_message;
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::{Phase, closing};
use crate::shared::text::client_text;

/// The actor.
pub struct WebClient {
    server: Arc<AppState>,
    peer: Peer,
    liveness: Liveness,
    /// Whether it has requested announcements.
    wants_announcements: bool,
    _permit: ConnectionPermit,
}

type Context = WebsocketContext<WebClient>;

impl WebClient {
    /// A client that has just connected; `permit` counts it.
    pub fn new(server: Arc<AppState>, peer: Peer, wants_announcements: bool, permit: ConnectionPermit) -> Self {
        Self {
            server,
            peer,
            liveness: Liveness::default(),
            wants_announcements,
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

    fn pick(&self, text: &str, ctx: &mut Context) {
        let server = Arc::clone(&self.server);
        let request = ServerRequest::parse(text);
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
                Err(failure) => {
                    if wants_reason {
                        ctx.text(refusal::reason_text(failure.reason));
                    }
                    ctx.text(refusal::sentence(&failure));
                }
            })
            .wait(ctx);
    }
}

/// A client's text: a request for a simulation server.
#[derive(Debug, PartialEq)]
struct ServerRequest {
    /// The URL of its world, if it names one.
    world: Option<String>,
    /// Whether it understands a text with the reason before that of an error.
    wants_reason: bool,
}

impl ServerRequest {
    /// Reads a URL or `{"url": ...}`; anything else names no world.
    fn parse(text: &str) -> Self {
        #[derive(Deserialize)]
        struct Wanted {
            url: Value,
            #[serde(default)]
            reason: Value,
        }
        let text = text.trim();
        match serde_json::from_str(text) {
            Ok(Wanted { url, reason }) => Self {
                world: Some(url.as_str().map_or_else(|| url.to_string(), str::to_owned)),
                wants_reason: reason == true,
            },
            Err(_) => Self {
                world: text.contains("://").then(|| text.to_owned()),
                wants_reason: false,
            },
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
            Ok(Message::Text(text)) if self.liveness.may_answer() => self.pick(&text, ctx),
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
            let request = ServerRequest::parse(text);
            assert_eq!(request.world.as_deref(), expected, "{text:?}");
            assert!(!request.wants_reason, "{text:?}");
        }
    }

    #[test]
    fn only_a_client_that_asks_for_the_reason_gets_it() {
        for (text, expected) in [
            (r#"{"url": "x", "reason": true}"#, true),
            (r#"{"url": "x", "reason": false}"#, false),
            (r#"{"url": "x", "reason": "true"}"#, false),
            (r#"{"reason": true}"#, false),
        ] {
            assert_eq!(ServerRequest::parse(text).wants_reason, expected, "{text}");
        }
    }
}
