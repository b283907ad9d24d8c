//! Actor: the session of one simulation, from the request for it to its end, as one state machine.
//!
//! Created by a web client that asks for a simulation. Whatever it holds in any state (a place in the line, a checkout
//! under way, a running Webots) is given back when it is dropped. It ends with its client.

use std::sync::Arc;

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

use super::attachment::{Attachment, FromClient, Said, ToClient};
use super::outcome::{Outcome, Pending};
use super::state::{StartRequest, State, WebotsHandle};
use crate::shared::http::Peer;
use crate::shared::run::closing;
use crate::simulation::checkout::{Progress, Project};
use crate::simulation::places::{PlaceEvent, Ticket};
use crate::simulation::protocol::{self, Mode};
use crate::simulation::readiness;
use crate::simulation::snapshot::Change;
use crate::simulation::state::AppState;
use crate::simulation::webots::{Exit, LaunchSpec, RestoreController, Webots, WebotsEvent};

/// The actor.
pub struct Session {
    server: Arc<AppState>,
    peer: Peer,
    /// The connection of its client, until it has ended.
    client: Option<Recipient<ToClient>>,
    attachment: u64,
    state: State,
    restoring: bool,
    start: Pending,
}

impl Session {
    /// Opens the session of a client that asks for the world at this URL.
    #[must_use]
    pub fn open(
        server: Arc<AppState>,
        peer: Peer,
        client: Recipient<ToClient>,
        (url, mode): (String, Mode),
    ) -> Attachment {
        let start = Pending::new(&server.starts);
        let session = Self {
            server,
            peer,
            client: Some(client),
            attachment: 0,
            state: State::Asked { url, mode },
            restoring: false,
            start,
        };
        let attachment = session.attachment;
        Attachment::new(session.start().recipient(), attachment)
    }

    fn name(&self) -> String {
        format!("client {}", self.peer)
    }

    /// Sends the client a text that it must not miss.
    fn text(&self, text: String) {
        if let Some(client) = &self.client {
            client.do_send(ToClient::Text(text));
        }
    }

    /// Sends the client a text that it misses where it can't keep up.
    fn hint(&self, text: String) {
        if let Some(client) = &self.client
            && let Err(lost) = client.try_send(ToClient::Text(text))
        {
            log::debug!("{}: does not listen: {lost}", self.name());
        }
    }

    /// Counts the failed start, sends the client the reason, and ends.
    fn fail_start(&mut self, outcome: Outcome, why: &str, ctx: &mut Context<Self>) {
        self.start.resolve(outcome);
        log::info!("{}: {why}", self.name());
        self.finish(protocol::error(why), CloseCode::Normal, ctx);
    }

    /// The same for a client that another server may take: the close code says so to programs.
    fn refer(&mut self, outcome: Outcome, why: &str, ctx: &mut Context<Self>) {
        self.start.resolve(outcome);
        log::info!("{}: {why}", self.name());
        self.finish(protocol::elsewhere(why), CloseCode::Again, ctx);
    }

    /// The same for a start that fails for a reason of this server's own, which is reported to session servers.
    fn fail_own(&mut self, outcome: Outcome, why: &str, ctx: &mut Context<Self>) {
        self.server.failed_starts.add(why);
        self.refer(outcome, why, ctx);
    }

    fn finish(&mut self, last_words: String, code: CloseCode, ctx: &mut Context<Self>) {
        self.state = State::Over;
        if let Some(client) = self.client.take() {
            client.do_send(ToClient::End(last_words, code));
        }
        ctx.stop();
    }

    fn ask(&mut self, url: &str, mode: Mode, ctx: &mut Context<Self>) {
        let address = self.peer.rate_limit_key();
        if !self.server.start_quota.take(address) {
            let why = "Too many simulations were asked for from your address. Try again in a minute";
            return self.fail_start(Outcome::Refused, why, ctx);
        }
        let world = match self.server.admit(url) {
            Ok(world) => world,
            Err(why) if self.server.takes_nobody() => return self.refer(Outcome::Refused, &why, ctx),
            Err(why) => return self.fail_start(Outcome::Refused, &why, ctx),
        };
        log::info!("{}: asks for {world}", self.name());
        let ticket = Ticket::new(&self.server.places, ctx.address().recipient(), world.to_string(), address);
        self.state = State::Waiting { request: StartRequest { world, mode }, ticket };
    }

    fn check_out(&mut self, StartRequest { world, mode }: StartRequest, place: (Ticket, u16), ctx: &mut Context<Self>) {
        let instance = match self.server.run.instance() {
            Ok(instance) => instance,
            Err(error) => return self.fail_own(Outcome::NoCheckout, &format!("No room for a project: {error}"), ctx),
        };
        self.state = State::CheckingOut { mode, place };
        let me = ctx.address();
        // Where the mailbox is full, the client misses one line of progress.
        let progress = move |text: String| drop(me.try_send(Progress(text)));
        let job = self.server.checkouts.start(world, instance, progress);
        job.into_actor(self)
            .map(|result, this, ctx| match result {
                Ok(Ok(project)) => this.launch(project, ctx),
                Ok(Err(error)) if error.is_own() => this.fail_own(Outcome::NoCheckout, &error.to_string(), ctx),
                Ok(Err(error)) => this.fail_start(Outcome::NoCheckout, &error.to_string(), ctx),
                Err(error) => this.fail_own(Outcome::NoCheckout, &format!("The checkout broke off: {error}"), ctx),
            })
            .spawn(ctx);
    }

    fn launch(&mut self, project: Project, ctx: &mut Context<Self>) {
        let (mode, place) = match std::mem::replace(&mut self.state, State::Over) {
            State::CheckingOut { mode, place } => (mode, place),
            other => return self.state = other,
        };
        let program = match readiness::webots_program(&self.server.config) {
            Ok(program) => program,
            Err(why) => return self.fail_own(Outcome::NoWebots, &why, ctx),
        };
        log::info!("{}: {} is for Webots {}", self.name(), project.world.path.display(), project.world.version);
        place.0.update(Change::Version(project.world.version.clone()));
        for warning in &project.warnings {
            self.text(protocol::loading(warning));
        }
        self.text(protocol::loading("webots is starting"));
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

    fn reset_controller(&mut self, file: String, ctx: &mut Context<Self>) {
        let State::Launched(WebotsHandle(webots)) = &self.state else {
            return self.text(protocol::nothing_to_reset());
        };
        if std::mem::replace(&mut self.restoring, true) {
            log::warn!("{}: asks to reset a controller while another is being reset; ignored", self.name());
            return;
        }
        let restored = webots.send(RestoreController(file.clone())).into_actor(self);
        restored
            .map(move |answer, this, _| {
                this.restoring = false;
                match answer {
                    Ok(Ok(())) => this.text(protocol::reset_controller(&file)),
                    // That does not end the simulation.
                    Ok(Err(error)) => this.text(protocol::error(&error.to_string())),
                    Err(error) => log::warn!("{}: no controller was reset: {error}", this.name()),
                }
            })
            .spawn(ctx);
    }

    fn exited(&mut self, Exit { clean, own, why }: &Exit, ctx: &mut Context<Self>) {
        if *own {
            let fail = if self.start.is_open() { Self::fail_own } else { Self::refer };
            return fail(self, Outcome::NoWebots, why, ctx);
        }
        let words = if *clean { protocol::loading(why) } else { protocol::error(why) };
        self.start.resolve(Outcome::NoWebots);
        self.finish(words, CloseCode::Normal, ctx);
    }
}

impl Actor for Session {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        closing(self.server.phase.clone())
            .into_actor(self)
            .map(|(), this, ctx| {
                this.start.resolve(Outcome::Stopped);
                this.finish(protocol::stopping(), CloseCode::Away, ctx);
            })
            .spawn(ctx);
        if let State::Asked { url, mode } = std::mem::replace(&mut self.state, State::Over) {
            self.ask(&url, mode, ctx);
        }
    }
}

impl Drop for Session {
    /// A client that still waits for something has lost it: its session has panicked.
    fn drop(&mut self) {
        if let Some(client) = self.client.take() {
            let why = protocol::error("The simulation was lost by a fault of this server");
            client.do_send(ToClient::End(why, CloseCode::Error));
        }
    }
}

impl Handler<FromClient> for Session {
    type Result = ();

    fn handle(&mut self, FromClient { attachment, what }: FromClient, ctx: &mut Self::Context) {
        if attachment != self.attachment {
            return;
        }
        match what {
            Said::ResetController(file) => self.reset_controller(file, ctx),
            Said::Gone => {
                self.client = None;
                ctx.stop();
            }
        }
    }
}

impl Handler<PlaceEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: PlaceEvent, ctx: &mut Self::Context) {
        match (event, std::mem::replace(&mut self.state, State::Over)) {
            (PlaceEvent::Granted(port), State::Waiting { request, ticket }) => {
                self.check_out(request, (ticket, port), ctx);
            }
            (PlaceEvent::Refused(full), State::Waiting { .. }) => {
                self.fail_start(Outcome::Full, &full.to_string(), ctx);
            }
            (PlaceEvent::Ahead(ahead), state @ State::Waiting { .. }) => {
                self.state = state;
                for text in protocol::queue(ahead) {
                    self.text(text);
                }
            }
            (_, state) => self.state = state,
        }
    }
}

impl Handler<Progress> for Session {
    type Result = ();

    fn handle(&mut self, Progress(text): Progress, _: &mut Self::Context) {
        if matches!(self.state, State::CheckingOut { .. }) {
            self.hint(protocol::loading(&text));
        }
    }
}

impl Handler<WebotsEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: WebotsEvent, ctx: &mut Self::Context) {
        match event {
            WebotsEvent::Progress(text) => self.hint(protocol::loading(&text)),
            WebotsEvent::Text(text) => self.text(protocol::of_project(&text)),
            WebotsEvent::Started => self.text(protocol::shutdown_timeout(self.server.config.timeout)),
            WebotsEvent::Listening(port) => {
                self.start.resolve(Outcome::Ready);
                self.server.failed_starts.reset();
                self.text(protocol::webots(&self.server.config.websocket_url(port)));
            }
            WebotsEvent::Heartbeat => self.hint(protocol::HEARTBEAT.to_owned()),
            WebotsEvent::Hanging(seconds) => {
                self.hint(protocol::loading(&format!("Webots has given no sign of life for {seconds} seconds")));
            }
            WebotsEvent::Exited(exit) => self.exited(&exit, ctx),
        }
    }
}
