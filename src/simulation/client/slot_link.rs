//! Actor: the WebSocket on `/slots` of one session server, for whose line this server reserves slots. If it wants, it is
//! also told which simulations run here, and stops some.
//!
//! Created by the route for each connection; ends with it. The session server proves first that it has the fleet's key.
//! What it wants replaces what it wanted before, and ends with the connection.

use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext};
use serde::Serialize;

use super::roster_feed::RosterFeed;
use crate::shared::domain::{
    FleetKey, Follow, Hello, KeepReady, Proof, StopOrder, Stopped, ToSessionServer, ToSimulationServer, Wishes,
};
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::MessageLimit;
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::{Phase, leaving};
use crate::shared::text::one_line;
use crate::simulation::slots::{LinkId, Reserved};
use crate::simulation::state::AppState;

/// The actor.
pub struct SlotLink {
    server: Arc<AppState>,
    peer: Peer,
    key: FleetKey,
    state: State,
    /// That of its messages.
    limit: MessageLimit,
    liveness: Liveness,
    _permit: ConnectionPermit,
}

/// What is known of the peer.
enum State {
    /// It has to answer this.
    Challenged(Hello),
    /// It has the key.
    Trusted {
        id: LinkId,
        /// What it was told of the simulations here, once it follows them.
        roster: Option<RosterFeed>,
    },
}

type Context = WebsocketContext<SlotLink>;

/// Interval between two looks at the simulations.
const LOOK: Duration = Duration::from_millis(250);
/// Time in which the peer must prove that it has the key.
const PROOF: Duration = Duration::from_secs(5);

impl SlotLink {
    /// A session server that has just connected; `limit` is that of its messages, and `permit` counts it.
    pub fn new(
        server: Arc<AppState>,
        peer: Peer,
        key: FleetKey,
        limit: MessageLimit,
        permit: ConnectionPermit,
    ) -> Self {
        let hello = Hello {
            challenge: rand::random(),
            server: server.server_run,
            pass: server.config.timing.pass.as_secs_f64(),
            keeps_ready: true,
            roster: true,
        };
        Self {
            server,
            peer,
            key,
            state: State::Challenged(hello),
            limit,
            liveness: Liveness::default(),
            _permit: permit,
        }
    }

    fn send(message: &impl Serialize, ctx: &mut Context) {
        // These messages can always be written.
        if let Ok(text) = serde_json::to_string(message) {
            ctx.text(text);
        }
    }

    fn handle_text(&mut self, text: &str, ctx: &mut Context) {
        match &self.state {
            State::Challenged(hello) => {
                let proof = serde_json::from_str::<Proof>(text);
                if !proof.is_ok_and(|proof| hello.is_proved(&self.key, &proof)) {
                    log::warn!("client {}: wants slots, and does not have the fleetKey", self.peer);
                    return Self::close(CloseCode::Policy, ctx);
                }
                log::info!(
                    "client {}: is a session server, for whose line slots are reserved",
                    self.peer
                );
                let id = LinkId(rand::random());
                self.state = State::Trusted { id, roster: None };
                self.limit.raise();
                self.server.slots.open_link(id, ctx.address().recipient());
            }
            State::Trusted { id, .. } => match serde_json::from_str(text) {
                Ok(ToSimulationServer::KeepReady(KeepReady { keep_ready })) => {
                    self.server.spare_wishes.ask(*id, keep_ready);
                }
                // During a fault they are kept: the session server takes them for known, and a probe may miss a short one.
                Ok(ToSimulationServer::Wishes(wishes)) if self.server.is_draining() => {
                    let nothing = Wishes {
                        first: Vec::new(),
                        all: 0,
                        ..wishes
                    };
                    self.server.slots.wish(*id, &nothing);
                }
                Ok(ToSimulationServer::Wishes(wishes)) => self.server.slots.wish(*id, &wishes),
                Ok(ToSimulationServer::Follow(follow)) => self.follow(&follow, ctx),
                Ok(ToSimulationServer::Stop(order)) => self.stop(order, ctx),
                Err(error) => {
                    log::warn!("client {}: {error}", self.peer);
                    Self::close(CloseCode::Policy, ctx);
                }
            },
        }
    }

    /// Stops simulations, and answers which.
    fn stop(&self, order: StopOrder, ctx: &mut Context) {
        let by = format!("session server {}, {}", self.peer, one_line(&order.by));
        let server = Arc::clone(&self.server);
        async move { (order.number, server.stop(&order.ids, &order.reason, &by).await) }
            .into_actor(self)
            .map(|(number, ids), _, ctx| Self::send(&ToSessionServer::Stopped(Stopped { number, ids }), ctx))
            .spawn(ctx);
    }

    /// Tells all simulations, and from now on what changes.
    fn follow(&mut self, follow: &Follow, ctx: &mut Context) {
        let page = url::Url::parse(&follow.page).ok();
        self.server
            .class_page
            .send_replace(page.filter(|page| matches!(page.scheme(), "http" | "https")));
        let State::Trusted { roster, .. } = &mut self.state else {
            return;
        };
        if roster.is_none() {
            ctx.run_interval(LOOK, Self::tell_changes);
        }
        roster.get_or_insert_default().has_figures = follow.figures;
        self.tell_changes(ctx);
    }

    /// The list of the simulations here, if the peer follows it.
    fn roster(&mut self) -> Option<&mut RosterFeed> {
        match &mut self.state {
            State::Challenged(_) => None,
            State::Trusted { roster, .. } => roster.as_mut(),
        }
    }

    fn tell_changes(&mut self, ctx: &mut Context) {
        let State::Trusted {
            roster: Some(roster), ..
        } = &mut self.state
        else {
            return;
        };
        for update in roster.updates(&self.server.slots.snapshot().simulations) {
            Self::send(&ToSessionServer::Roster(update), ctx);
        }
        if roster.is_due() {
            self.measure(ctx);
        }
    }

    /// Measures what simulations use. The figures follow with the next look at the simulations.
    fn measure(&mut self, ctx: &mut Context) {
        if let Some(roster) = self.roster() {
            roster.begin();
        }
        let server = Arc::clone(&self.server);
        async move { server.usages(&server.slots.snapshot()).await }
            .into_actor(self)
            .map(|usages, link, _| {
                if let Some(roster) = link.roster() {
                    roster.usages = usages;
                }
            })
            .spawn(ctx);
    }

    fn close(code: CloseCode, ctx: &mut Context) {
        ctx.close(Some(CloseReason {
            code,
            description: None,
        }));
        ctx.stop();
    }
}

impl Actor for SlotLink {
    type Context = Context;

    fn started(&mut self, ctx: &mut Self::Context) {
        let timing = &self.server.config.timing;
        liveness::watch(ctx, timing.ping, timing.silence, |link| &mut link.liveness);
        if let State::Challenged(hello) = &self.state {
            Self::send(hello, ctx);
        }
        ctx.run_later(PROOF, |link, ctx| {
            if let State::Challenged(_) = link.state {
                Self::close(CloseCode::Policy, ctx);
            }
        });
        let mut phase = self.server.phase.subscribe();
        async move { phase.wait_for(|phase| *phase != Phase::Open).await.is_ok() }
            .into_actor(self)
            .map(|_, link, _| {
                if let State::Trusted { id, .. } = link.state {
                    link.server.slots.clear_wishes(id);
                }
            })
            .spawn(ctx);
        leaving(self.server.phase.subscribe())
            .into_actor(self)
            .map(|(), _, ctx| Self::close(CloseCode::Away, ctx))
            .spawn(ctx);
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        if let State::Trusted { id, .. } = self.state {
            self.server.slots.close_link(id);
            self.server.spare_wishes.leave(id);
        }
    }
}

impl Handler<Reserved> for SlotLink {
    type Result = ();

    fn handle(&mut self, Reserved(offers): Reserved, ctx: &mut Self::Context) {
        Self::send(&offers, ctx);
    }
}

impl StreamHandler<Result<Message, ProtocolError>> for SlotLink {
    fn handle(&mut self, message: Result<Message, ProtocolError>, ctx: &mut Self::Context) {
        match message {
            Ok(Message::Text(text)) => self.handle_text(&text, ctx),
            Ok(Message::Ping(data)) if self.liveness.may_answer() => ctx.pong(&data),
            Ok(Message::Pong(content)) => self.liveness.pong(&content),
            Ok(Message::Close(reason)) => {
                ctx.close(reason);
                ctx.stop();
            }
            _ => Self::close(CloseCode::Policy, ctx),
        }
    }
}
