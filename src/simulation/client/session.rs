//! Actor: the session of one simulation, from the request for it to its end, as one state machine.
//!
//! Created by a web client that requests a simulation. Dropping it releases what it holds in its state: a position in
//! the queue, a checkout in progress, a running Webots. It ends with its client's connection, or some time later if the
//! client may return. `start` contains the way to a running Webots, `resume` the wait for the client.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;
use futures_util::stream::AbortHandle;

use crate::shared::domain::ProjectUrl;
use crate::shared::http::Peer;
use crate::shared::run::closing;
use crate::simulation::checkout::Project;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{EndReason, Taken};
use crate::simulation::protocol::{self, Mode, SceneKind};
use crate::simulation::sessions::{ClientAction, Connection, ToClient, Token};
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{Slot, SlotEvent, SlotLease};
use crate::simulation::state::AppState;
use crate::simulation::webots::{Keep, Stop, Webots, WebotsEvent, WebotsExit};

/// The actor.
pub struct Session {
    pub(super) server: Arc<AppState>,
    pub(super) peer: Peer,
    /// The id of the simulation, once there is one.
    pub(super) id: Option<SimulationId>,
    /// The connection of its client; `None` once it has ended.
    pub(super) client: Option<Recipient<ToClient>>,
    /// Detaches that connection at once.
    pub(super) attachment: Option<AbortHandle>,
    pub(super) state: State,
    /// The project that was checked out, as long as its Webots holds it.
    pub(super) project: Weak<Project>,
    /// How it is shown.
    pub(super) mode: Mode,
    /// The 3D scene that its Webots streams, once that is known; `None` for a video.
    pub(super) kind: Option<SceneKind>,
    /// Whether its client may resume it.
    pub(super) resumable: bool,
    /// The last token that the client got; `None` before it can return.
    pub(super) token: Option<Token>,
    /// When Webots was started: the time limit starts then.
    pub(super) launched: Option<Instant>,
    /// The texts that its project requests, kept for a client that returns.
    pub(super) texts: Vec<String>,
    /// The URL of Webots, once it is ready.
    pub(super) url: Option<String>,
    /// When the simulation ends because it is paused; `None` if it does not.
    pub(super) idle_end: Option<Instant>,
    pub(super) is_watched: bool,
    /// The timer that ends the wait for the client, while it waits.
    pub(super) deadline: Option<SpawnHandle>,
    /// Why the simulation has ended, if it has.
    pub(super) ended: Option<String>,
    /// Whether a controller is being reset.
    is_resetting: bool,
}

/// The life cycle of a simulation, as its session knows it. Dropping a state releases what the session holds in it.
pub(super) enum State {
    /// Waiting for a slot; the lease holds the position in the queue.
    Waiting { world: ProjectUrl, lease: SlotLease },
    /// The project is being checked out for this slot; the job ends with the actor.
    CheckingOut(Slot),
    /// Webots was started.
    Launched(WebotsHandle),
    /// Nothing is held: the simulation was not admitted yet, or its client got the last text.
    Over,
}

/// A running Webots. Dropping the handle stops it.
pub(super) struct WebotsHandle(pub(super) Addr<Webots>);

impl Drop for WebotsHandle {
    fn drop(&mut self) {
        self.0.do_send(Stop(EndReason::Left));
    }
}

/// Interval of `absence` messages to a client that may return, which show that the connection works.
const SIGN_OF_LIFE: Duration = Duration::from_secs(4);

/// Seconds until then, rounded up.
pub(super) fn seconds_until(then: Instant) -> u64 {
    (then.saturating_duration_since(Instant::now()) + Duration::from_millis(999)).as_secs()
}

impl Session {
    /// Opens the session of a client that requests a simulation.
    pub fn open(server: Arc<AppState>, identity: ClientIdentity, connection: Connection, request: &protocol::Start) {
        Self::create(|ctx| {
            let mut session = Self {
                resumable: request.resumable.unwrap_or_default() && !server.config.timing.absence.is_zero(),
                server,
                peer: connection.peer,
                id: None,
                client: None,
                attachment: None,
                state: State::Over,
                project: Weak::new(),
                mode: request.mode.unwrap_or_default(),
                kind: None,
                token: None,
                launched: None,
                texts: Vec::new(),
                url: None,
                idle_end: None,
                is_watched: false,
                deadline: None,
                ended: None,
                is_resetting: false,
            };
            session.attach(connection, ctx);
            session.request_slot(&request.url, identity, ctx);
            session
        });
    }

    pub(super) fn name(&self) -> String {
        let id = self.id.map(|id| format!("{id}: ")).unwrap_or_default();
        format!("{id}client {}", self.peer)
    }

    /// Sends the client a text that it must not miss.
    pub(super) fn text(&self, text: String) {
        if let Some(client) = &self.client {
            client.do_send(ToClient::Text(text));
        }
    }

    /// Sends the client a text that is dropped if it can't keep up.
    fn hint(&self, text: String) {
        if let Some(client) = &self.client {
            client.try_send(ToClient::Text(text)).ok();
        }
    }

    /// Releases everything, and sends the client the last text. A client that missed it receives `why` when it returns.
    pub(super) fn finish(&mut self, last_words: String, why: &str, code: CloseCode, ctx: &mut Context<Self>) {
        self.state = State::Over;
        if let Some(client) = self.client.take() {
            client.do_send(ToClient::End(last_words, code));
        }
        self.ended.get_or_insert_with(|| why.to_owned());
        self.await_client(ctx);
    }

    fn reset_controller(&mut self, file: String, ctx: &mut Context<Self>) {
        let Some(project) = self.project.upgrade() else {
            return self.text(protocol::nothing_to_reset());
        };
        if self.is_resetting {
            return log::info!("{}: a controller is being reset already", self.name());
        }
        self.is_resetting = true;
        let checkouts = Arc::clone(&self.server.checkouts);
        let restored = async move { checkouts.restore_controller(&project, &file).await.map(|()| file) };
        let restored = restored.into_actor(self).map(|restored, this, _| {
            this.is_resetting = false;
            match restored {
                Ok(file) => this.text(protocol::reset_controller(&file)),
                // This error does not end the simulation.
                Err(error) => this.text(protocol::error(&error.to_string())),
            }
        });
        restored.spawn(ctx);
    }

    /// Reports how the simulation ends, before the state is dropped. Webots' own report takes precedence.
    pub(super) fn end(&self, reason: EndReason, why: &str) {
        match &self.state {
            State::Waiting { lease, .. } | State::CheckingOut(Slot { lease, .. }) => {
                lease.end(reason, why, Taken::default());
            }
            State::Launched(WebotsHandle(webots)) => webots.do_send(Stop(reason)),
            State::Over => {}
        }
    }

    fn exited(&mut self, WebotsExit { clean, own, why }: &WebotsExit, ctx: &mut Context<Self>) {
        if *own {
            return if self.url.is_some() {
                self.refer(why, ctx);
            } else {
                self.fail_own(why, ctx);
            };
        }
        let words = if *clean {
            protocol::loading(why)
        } else {
            protocol::error(why)
        };
        self.finish(words, why, CloseCode::Normal, ctx);
    }
}

impl Actor for Session {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        closing(self.server.phase.subscribe())
            .into_actor(self)
            .map(|(), this, ctx| {
                this.end(EndReason::Stopped, "The server was stopped");
                this.finish(protocol::stopping(), "", CloseCode::Away, ctx);
                ctx.stop();
            })
            .spawn(ctx);
    }
}

impl StreamHandler<ClientAction> for Session {
    fn handle(&mut self, action: ClientAction, ctx: &mut Self::Context) {
        match action {
            ClientAction::ResetController(file) => self.reset_controller(file, ctx),
            ClientAction::Keep => {
                if let State::Launched(WebotsHandle(webots)) = &self.state {
                    webots.do_send(Keep);
                }
            }
            ClientAction::Leave => ctx.stop(),
            ClientAction::Disconnect => {
                self.client = None;
                self.await_client(ctx);
            }
        }
    }

    fn finished(&mut self, _: &mut Self::Context) {}
}

impl Handler<SlotEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: SlotEvent, ctx: &mut Self::Context) {
        match event {
            SlotEvent::Granted(port) => {
                if let State::Waiting { world, lease } = std::mem::replace(&mut self.state, State::Over) {
                    self.check_out(world, Slot { lease, port }, ctx);
                }
            }
            SlotEvent::Queued(ahead) => protocol::queue(ahead).into_iter().for_each(|text| self.text(text)),
            SlotEvent::Watched(is_watched) => {
                self.is_watched = is_watched;
                self.text(protocol::watched(is_watched));
            }
            SlotEvent::Stopped(why) => {
                self.end(EndReason::Administrator, "The administrator has stopped it");
                self.finish(protocol::error(&why), &why, CloseCode::Normal, ctx);
            }
            // Its client may have come back meanwhile.
            SlotEvent::MakeRoom if self.client.is_none() => {
                let why = "Others wait for a place, and your address has left several simulations behind";
                self.end(EndReason::Left, why);
                self.finish(protocol::error(why), why, CloseCode::Normal, ctx);
            }
            SlotEvent::MakeRoom => {}
        }
    }
}

impl Handler<WebotsEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: WebotsEvent, ctx: &mut Self::Context) {
        match event {
            WebotsEvent::Progress(text) => self.hint(protocol::loading(&text)),
            WebotsEvent::Text(text) => {
                let text = protocol::of_project(&text);
                self.texts.push(text.clone());
                self.text(text);
            }
            WebotsEvent::Started => {
                self.launched = Some(Instant::now());
                self.text(protocol::shutdown_timeout(self.server.config.timeout));
            }
            WebotsEvent::Listening(port, stream) => {
                self.count("ready");
                self.server.failed_starts.reset();
                self.url = Some(self.server.config.stream_url(port, &stream.reveal()));
                self.offer(ctx);
                if self.resumable {
                    let absence = self.server.config.timing.absence.as_secs();
                    // While Webots is busy it sends nothing, and its client would assume a lost connection.
                    ctx.run_interval(SIGN_OF_LIFE, move |this, _| this.hint(protocol::absence(absence)));
                }
            }
            WebotsEvent::Heartbeat => self.hint(protocol::HEARTBEAT.to_owned()),
            WebotsEvent::Hanging(seconds) => self.hint(protocol::hanging(seconds)),
            WebotsEvent::IdleEnd(end) => {
                self.idle_end = end;
                self.text(protocol::idle(end.map(seconds_until)));
            }
            WebotsEvent::Exited(exit) => self.exited(&exit, ctx),
        }
    }
}
