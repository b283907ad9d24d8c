//! Actor: one WebSocket on `/client`. Its life is the life of one simulation, as one state machine.
//!
//! Created by the route for each connection; ends with it. The connection is the lease: whatever this actor holds in
//! any state (a place in the line, a checkout under way, a running Webots) is given back when it is dropped.

use std::sync::Arc;

use actix::prelude::*;
use actix_web_actors::ws::{CloseCode, CloseReason, Message, ProtocolError, WebsocketContext};

use super::outcome::{Outcome, Pending};
use super::state::{StartRequest, State, WebotsHandle};
use crate::shared::http::liveness::{self, Liveness};
use crate::shared::http::websocket::{ClientMessage, MessageReader};
use crate::shared::http::{ConnectionPermit, Peer};
use crate::shared::run::closing;
use crate::simulation::checkout::{Progress, Project};
use crate::simulation::ends::EndReason;
use crate::simulation::places::{PlaceEvent, Ticket};
use crate::simulation::protocol::{self, Mode, Request};
use crate::simulation::readiness;
use crate::simulation::snapshot::Change;
use crate::simulation::state::AppState;
use crate::simulation::webots::{Exit, LaunchSpec, RestoreController, Webots, WebotsEvent};

/// The actor.
pub struct WebClient {
    server: Arc<AppState>,
    peer: Peer,
    id: String,
    state: State,
    liveness: Liveness,
    restoring: bool,
    start: Pending,
    reader: MessageReader,
    _permit: ConnectionPermit,
}

type Context = WebsocketContext<WebClient>;

impl WebClient {
    /// A client that has just connected; `permit` counts it, `reader` reads its messages.
    #[must_use]
    pub fn new(server: Arc<AppState>, peer: Peer, (permit, reader): (ConnectionPermit, MessageReader)) -> Self {
        Self {
            server,
            peer,
            id: String::new(),
            state: State::Connected,
            liveness: Liveness::new(),
            restoring: false,
            start: Pending::default(),
            reader,
            _permit: permit,
        }
    }

    fn name(&self) -> String {
        format!("{}client {}", self.id, self.peer)
    }

    /// Counts the failed start, sends the client the reason, and closes the connection.
    fn fail_start(&mut self, outcome: Outcome, why: &str, ctx: &mut Context) {
        self.start.resolve(outcome);
        self.state.end(outcome.end(), why);
        log::info!("{}: {why}", self.name());
        self.finish(&protocol::error(why), CloseCode::Normal, ctx);
    }

    /// The same for a client that another server may take: the close code says so to programs.
    fn refer(&mut self, outcome: Outcome, why: &str, ctx: &mut Context) {
        self.start.resolve(outcome);
        log::info!("{}: {why}", self.name());
        self.finish(&protocol::elsewhere(why), CloseCode::Again, ctx);
    }

    /// The same for a start that fails for a reason of this server's own, which is reported to session servers.
    fn fail_own(&mut self, outcome: Outcome, why: &str, ctx: &mut Context) {
        self.server.failed_starts.add(&format!("{}: {why}", self.name()));
        self.state.end(EndReason::Fault, why);
        self.refer(outcome, why, ctx);
    }

    fn finish(&mut self, last_words: &str, code: CloseCode, ctx: &mut Context) {
        self.state = State::Over;
        ctx.text(last_words.to_owned());
        ctx.close(Some(CloseReason { code, description: None }));
        ctx.stop();
    }

    fn understand(&mut self, text: &str, ctx: &mut Context) {
        match Request::parse(text) {
            Ok(Some(Request::Start { url, mode })) => self.start(&url, mode, ctx),
            Ok(Some(Request::ResetController(file))) => self.reset_controller(file, ctx),
            Ok(None) => log::debug!("{}: a message that asks for nothing is ignored", self.name()),
            Err(wrong) => {
                log::info!("{}: {wrong}", self.name());
                self.finish(&protocol::error(&wrong.to_string()), CloseCode::Normal, ctx);
            }
        }
    }

    fn start(&mut self, url: &str, mode: Mode, ctx: &mut Context) {
        if !matches!(self.state, State::Connected) {
            log::warn!("{}: asks for a second simulation on one connection; ignored", self.name());
            return;
        }
        self.start = Pending::new(&self.server.starts);
        if !self.server.start_quota.take(self.peer.rate_limit_key()) {
            let why = "Too many simulations were asked for from your address. Try again in a minute";
            return self.fail_start(Outcome::Refused, why, ctx);
        }
        let world = match self.server.admit(url) {
            Ok(world) => world,
            Err(why) if self.server.takes_nobody() => return self.refer(Outcome::Refused, &why, ctx),
            Err(why) => return self.fail_start(Outcome::Refused, &why, ctx),
        };
        let ticket = Ticket::new(&self.server.places, ctx.address().recipient(), &world, self.peer);
        self.id = format!("{}: ", ticket.id());
        ctx.text(protocol::session(ticket.id()));
        log::info!("{}: asks for {world}", self.name());
        self.state = State::Waiting { request: StartRequest { world, mode }, ticket };
    }

    fn check_out(&mut self, StartRequest { world, mode }: StartRequest, ticket: Ticket, port: u16, ctx: &mut Context) {
        self.state = State::CheckingOut { mode, place: (ticket, port) };
        let instance = match self.server.run.instance() {
            Ok(instance) => instance,
            Err(error) => return self.fail_own(Outcome::NoCheckout, &format!("No room for a project: {error}"), ctx),
        };
        let me = ctx.address();
        // Where the mailbox is full, the client misses one line of progress.
        let progress = move |text: String| drop(me.try_send(Progress(text)));
        let job = self.server.checkouts.start(world, instance, progress).into_actor(self);
        job.map(|result, this, ctx| match result {
            Ok(Ok(project)) => this.launch(project, ctx),
            Ok(Err(error)) if error.is_own() => this.fail_own(Outcome::NoCheckout, &error.to_string(), ctx),
            Ok(Err(error)) => this.fail_start(Outcome::NoCheckout, &error.to_string(), ctx),
            Err(error) => this.fail_own(Outcome::NoCheckout, &format!("The checkout broke off: {error}"), ctx),
        })
        .spawn(ctx);
    }

    fn launch(&mut self, project: Project, ctx: &mut Context) {
        let program = match readiness::webots_program(&self.server.config) {
            Ok(program) => program,
            Err(why) => return self.fail_own(Outcome::NoWebots, &why, ctx),
        };
        let State::CheckingOut { mode, place } = std::mem::replace(&mut self.state, State::Over) else { return };
        log::info!("{}: {} is for Webots {}", self.name(), project.world.path.display(), project.world.version);
        place.0.update(Change::Version(project.world.version.clone()));
        project.warnings.iter().for_each(|warning| ctx.text(protocol::loading(warning)));
        ctx.text(protocol::loading("webots is starting"));
        let spec = LaunchSpec {
            config: Arc::clone(&self.server.config),
            containers: self.server.containers.clone(),
            launcher: Arc::clone(&self.server.launcher),
            watcher: self.server.watcher.clone(),
            program,
            checkouts: Arc::clone(&self.server.checkouts),
            project: Arc::new(project),
            mode,
            place,
            events: ctx.address().recipient(),
        };
        let webots = Webots::start_in_arbiter(self.server.webots_thread(spec.place.1), |_| Webots::new(spec));
        self.state = State::Launched(WebotsHandle(webots));
    }

    fn reset_controller(&mut self, file: String, ctx: &mut Context) {
        let State::Launched(WebotsHandle(webots)) = &self.state else {
            return ctx.text(protocol::error("A controller can be reset only while a simulation runs"));
        };
        if std::mem::replace(&mut self.restoring, true) {
            log::warn!("{}: asks to reset a controller while another is being reset; ignored", self.name());
            return;
        }
        webots
            .send(RestoreController(file.clone()))
            .into_actor(self)
            .map(move |answer, this, ctx| {
                this.restoring = false;
                match answer {
                    Ok(Ok(())) => ctx.text(protocol::reset_controller(&file)),
                    // That does not end the simulation.
                    Ok(Err(error)) => ctx.text(protocol::error(&error.to_string())),
                    Err(error) => log::warn!("{}: no controller was reset: {error}", this.name()),
                }
            })
            .spawn(ctx);
    }

    fn exited(&mut self, Exit { clean, own, why }: &Exit, ctx: &mut Context) {
        if *own {
            let fail = if self.start.is_open() { Self::fail_own } else { Self::refer };
            return fail(self, Outcome::NoWebots, why, ctx);
        }
        let words = if *clean { protocol::loading(why) } else { protocol::error(why) };
        self.start.resolve(Outcome::NoWebots);
        self.finish(&words, CloseCode::Normal, ctx);
    }
}

impl Actor for WebClient {
    type Context = Context;

    fn started(&mut self, ctx: &mut Self::Context) {
        log::info!("{}: connected", self.name());
        let timing = &self.server.config.timing;
        liveness::watch(ctx, timing.ping, timing.silence, |client| &mut client.liveness);
        closing(self.server.phase.clone())
            .into_actor(self)
            .map(|(), this, ctx| {
                this.start.resolve(Outcome::Stopped);
                this.state.end(EndReason::Stopped, "The server was stopped");
                this.finish(&protocol::error("This simulation server is stopping"), CloseCode::Away, ctx);
            })
            .spawn(ctx);
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        log::info!("{}: gone", self.name());
    }
}

impl StreamHandler<Result<Message, ProtocolError>> for WebClient {
    fn handle(&mut self, message: Result<Message, ProtocolError>, ctx: &mut Self::Context) {
        match self.reader.read(message) {
            Ok(Some(ClientMessage::Text(text))) if self.liveness.may_answer() => self.understand(&text, ctx),
            Ok(Some(ClientMessage::Ping(data))) if self.liveness.may_answer() => ctx.pong(&data),
            Ok(Some(ClientMessage::Pong(content))) => self.liveness.pong(&content),
            Ok(Some(ClientMessage::Close(reason))) => {
                ctx.close(reason);
                ctx.stop();
            }
            Ok(None) => {}
            Ok(Some(ClientMessage::Text(_) | ClientMessage::Ping(_))) => {
                log::warn!("{}: asks too much between two pings", self.name());
                self.finish(&protocol::error("Too many requests on one connection"), CloseCode::Policy, ctx);
            }
            Err(error) => {
                log::info!("{}: {error}", self.name());
                self.finish(&protocol::error(&error.to_string()), error.code(), ctx);
            }
        }
    }
}

impl Handler<PlaceEvent> for WebClient {
    type Result = ();

    fn handle(&mut self, event: PlaceEvent, ctx: &mut Self::Context) {
        match (event, std::mem::replace(&mut self.state, State::Over)) {
            (PlaceEvent::Granted(port), State::Waiting { request, ticket }) => {
                self.check_out(request, ticket, port, ctx);
            }
            (PlaceEvent::Refused(full), State::Waiting { .. }) => {
                self.fail_start(Outcome::Full, &full.to_string(), ctx);
            }
            (PlaceEvent::Ahead(ahead), state @ State::Waiting { .. }) => {
                self.state = state;
                for text in protocol::queue(ahead) {
                    ctx.text(text);
                }
            }
            (_, state) => self.state = state,
        }
    }
}

impl Handler<Progress> for WebClient {
    type Result = ();

    fn handle(&mut self, Progress(text): Progress, ctx: &mut Self::Context) {
        if matches!(self.state, State::CheckingOut { .. }) {
            ctx.text(protocol::loading(&text));
        }
    }
}

impl Handler<WebotsEvent> for WebClient {
    type Result = ();

    fn handle(&mut self, event: WebotsEvent, ctx: &mut Self::Context) {
        match event {
            WebotsEvent::Progress(text) => ctx.text(protocol::loading(&text)),
            WebotsEvent::Text(text) => ctx.text(protocol::of_project(&text)),
            WebotsEvent::Started => ctx.text(protocol::shutdown_timeout(self.server.config.timeout)),
            WebotsEvent::Listening(port) => {
                self.start.resolve(Outcome::Ready);
                self.server.failed_starts.reset();
                ctx.text(protocol::webots(&self.server.config.websocket_url(port)));
            }
            WebotsEvent::Heartbeat => ctx.text(protocol::HEARTBEAT),
            WebotsEvent::Hanging(seconds) => ctx.text(protocol::hanging(seconds)),
            WebotsEvent::Exited(exit) => self.exited(&exit, ctx),
        }
    }
}
