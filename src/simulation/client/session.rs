//! Actor: the session of one simulation, from the request for it to its end, as one state machine.
//!
//! Created by a web client that requests a simulation, or by the [`SpareKeeper`](super::SpareKeeper), which keeps some ready
//! until a client takes them (`spare`). Dropping it releases what it holds in its state: a position in
//! the queue, a checkout in progress, a running Webots. It ends with its client's connection, or some time later if the
//! client may return. `start` contains the way to a running Webots, `resume` the wait for the client,
//! `arrival` that for the first viewer.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use actix::prelude::*;
use futures_util::stream::AbortHandle;
use tokio_util::sync::DropGuard;

use crate::shared::domain::{Failure, ProjectUrl, Reason, ReservationId, View};
use crate::shared::http::Peer;
use crate::shared::run::closing;
use crate::simulation::attachment::{ClientAction, Connection, NewClient, ToClient, Token};
use crate::simulation::checkout::Project;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::container::ImageUse;
use crate::simulation::ends::{StopReason, lost};
use crate::simulation::progress::Progress;
use crate::simulation::protocol;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{QueuePosition, Slot, SlotEvent, SpareKind, Taker};
use crate::simulation::snapshot::SceneKind;
use crate::simulation::state::AppState;
use crate::simulation::webots::{Keep, Stop, Webots, WebotsEvent};

/// The actor.
pub struct Session {
    pub(super) server: Arc<AppState>,
    /// The id of the simulation.
    pub(super) id: SimulationId,
    pub(super) client: Client,
    pub(super) state: State,
    /// How its client wants to see it.
    pub(super) view: View,
}

/// The client of a session.
pub(super) enum Client {
    /// None has taken the simulation, which is kept ready.
    Expected(Expected),
    /// It is connected.
    Connected(Attachment),
    /// It may come back.
    Away(Absence),
}

/// What a simulation is kept ready for.
pub(super) struct Expected {
    pub(super) kind: SpareKind,
    /// Its keeper, which is told how that goes.
    pub(super) keeper: Recipient<SpareEvent>,
}

/// What happens to a simulation that is kept ready, for its keeper.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub enum SpareEvent {
    /// One is ready, in a container with these images.
    Ready(SpareKind, Vec<ImageUse>),
    /// One has failed to start, or has ended although nobody has asked for that.
    Failed(SpareKind, Failure),
}

/// Whether the client of a session may come back once its connection has broken.
#[derive(Clone, Copy)]
pub(super) enum Comeback {
    /// It may not.
    Never,
    /// Once Webots is ready, when it gets a token.
    OnceReady,
    /// With this token, the last that it got.
    With(Token),
}

impl Comeback {
    /// For a client that has asked for it or not.
    pub(super) fn asked(resumable: bool) -> Self {
        if resumable { Self::OnceReady } else { Self::Never }
    }
}

/// A connection that is attached to a session. Dropping it detaches the connection at once.
pub(super) struct Attachment {
    /// The address of the client.
    pub(super) peer: Peer,
    pub(super) comeback: Comeback,
    /// Receives what is for the client.
    pub(super) client: Recipient<ToClient>,
    /// Ends the stream of the client's actions.
    pub(super) actions: AbortHandle,
}

impl Drop for Attachment {
    fn drop(&mut self) {
        self.actions.abort();
    }
}

/// The absence of a client.
pub(super) struct Absence {
    /// The address of its last connection.
    pub(super) peer: Peer,
    /// With this token it comes back.
    pub(super) token: Token,
    /// Ends the session.
    pub(super) timer: SpawnHandle,
}

/// The last progress of a start, as it was sent, for a client that comes back.
pub(super) type SentProgress = [String; 2];

/// The life cycle of a simulation, as its session knows it. Each state holds what exists only in it; dropping a state
/// releases that.
pub(super) enum State {
    /// Waiting for a slot.
    Waiting {
        world: ProjectUrl,
        position: QueuePosition,
        /// The number of clients ahead, once it is known.
        ahead: Option<usize>,
    },
    /// The project is being checked out.
    CheckingOut {
        /// The slot in which the simulation will run.
        slot: Slot,
        /// `None` before the first step.
        progress: Option<SentProgress>,
        /// Cancels the checkout when it is dropped.
        _checkout: DropGuard,
    },
    /// Webots was requested, and is not ready.
    Launching {
        launched: LaunchedSimulation,
        progress: SentProgress,
    },
    /// Webots is ready.
    Ready(ReadySimulation),
    /// The simulation has ended, or was not admitted. A client that may come back hears why.
    Over(Failure),
}

/// A simulation whose Webots was requested.
pub(super) struct LaunchedSimulation {
    pub(super) webots: WebotsHandle,
    /// The project that was checked out, as long as its Webots holds it.
    pub(super) project: Weak<Project>,
    /// The 3D scene that its Webots streams; `None` for a video.
    pub(super) scene: Option<SceneKind>,
    /// The texts that its project requests, kept for a client that returns.
    pub(super) texts: Vec<String>,
    /// When its time limit has begun: with the start of Webots, or with its client.
    pub(super) started: Option<Instant>,
    /// Whether a controller is being reset.
    pub(super) is_resetting: bool,
}

/// A simulation whose Webots is ready.
pub(super) struct ReadySimulation {
    pub(super) launched: LaunchedSimulation,
    /// The port on which Webots listens.
    pub(super) port: u16,
    /// The URL of Webots.
    pub(super) url: String,
    /// When the simulation ends because it is paused; `None` if it does not.
    pub(super) idle_end: Option<Instant>,
    /// Whether an administrator watches it.
    pub(super) is_watched: bool,
    pub(super) arrival: Arrival,
}

/// The arrival of the first viewer.
pub(super) enum Arrival {
    /// Nobody is known to have opened the stream. This timer ends the simulation.
    Awaited(SpawnHandle),
    /// A viewer was there, or may come at any time.
    Settled,
}

/// A running Webots. Dropping the handle stops it.
pub(super) struct WebotsHandle(pub(super) Addr<Webots>);

impl Drop for WebotsHandle {
    /// A session that ends in order has requested this end before, and only the first reason counts.
    fn drop(&mut self) {
        self.0.do_send(Stop(StopReason::SessionLost));
    }
}

/// Interval of `absence` messages to a client that may return, which show that the connection works.
const SIGN_OF_LIFE: Duration = Duration::from_secs(4);

/// Seconds until then, rounded up.
pub(super) fn seconds_until(then: Instant) -> u64 {
    (then.saturating_duration_since(Instant::now()) + Duration::from_millis(999)).as_secs()
}

impl State {
    /// The end of a session that has panicked; also what is left of a state while the next one is made of it.
    pub(super) fn lost() -> Self {
        Self::Over(lost())
    }

    pub(super) fn launched(&self) -> Option<&LaunchedSimulation> {
        match self {
            Self::Launching { launched, .. } | Self::Ready(ReadySimulation { launched, .. }) => Some(launched),
            Self::Waiting { .. } | Self::CheckingOut { .. } | Self::Over(_) => None,
        }
    }

    pub(super) fn launched_mut(&mut self) -> Option<&mut LaunchedSimulation> {
        match self {
            Self::Launching { launched, .. } | Self::Ready(ReadySimulation { launched, .. }) => Some(launched),
            Self::Waiting { .. } | Self::CheckingOut { .. } | Self::Over(_) => None,
        }
    }
}

impl Session {
    /// Gives a client that requests a simulation one that is kept ready, or opens a session for it and returns that; or
    /// tells the client why it gets none.
    pub fn open(
        server: &Arc<AppState>,
        identity: ClientIdentity,
        connection: Connection,
        request: &protocol::Start,
    ) -> Option<Addr<Self>> {
        let (world, reservation) = match Self::admit(server, connection.peer, request) {
            Ok(admitted) => admitted,
            Err(failure) => {
                connection.client.do_send(ToClient::Close(failure));
                return None;
            }
        };
        let client = NewClient {
            connection,
            identity,
            world,
            view: request.mode.unwrap_or_default().into(),
            resumable: request.resumable.unwrap_or_default() && !server.config.timing.absence.is_zero(),
            early: request.early.unwrap_or_default(),
        };
        let taker = Taker {
            kind: SpareKind {
                world: client.world.clone(),
                view: client.view,
            },
            peer: client.connection.peer,
            identity: client.identity.clone(),
        };
        match server.slots.take_spare(&taker, reservation) {
            // The session exists until it has received this.
            Some((session, again)) => {
                session.do_send(SlotEvent::Taken(Box::new(client), again));
                None
            }
            None => Some(Self::start_for(Arc::clone(server), client, reservation)),
        }
    }

    /// Starts a simulation for a client.
    pub(super) fn start_for(
        server: Arc<AppState>,
        client: NewClient,
        reservation: Option<ReservationId>,
    ) -> Addr<Self> {
        let NewClient {
            connection,
            identity,
            world,
            view,
            resumable,
            early,
        } = client;
        let id = SimulationId::next();
        let peer = connection.peer;
        log::info!("{id}: client {peer}: asks for {world}{identity}");
        Self::create(|ctx| {
            let me = ctx.address().recipient();
            let state = match QueuePosition::join(&server.slots, id, me, &world, (peer, identity), reservation) {
                Ok(position) => State::Waiting {
                    world,
                    position,
                    ahead: None,
                },
                Err(failure) => State::Over(failure),
            };
            let mut session = Self {
                server,
                id,
                client: Client::Connected(Self::attached(connection, Comeback::asked(resumable), ctx)),
                state,
                view,
            };
            session.text(protocol::simulation_id(id));
            if let State::Over(failure) = &session.state {
                session.count(failure.reason.code());
                session.tell(failure);
                ctx.stop();
            } else if early {
                session.issue_token(ctx);
                session.offer_comeback();
            }
            session
        })
    }

    pub(super) fn name(&self) -> String {
        match self.peer() {
            Some(peer) => format!("{}: client {peer}", self.id),
            None => format!("{}: kept ready", self.id),
        }
    }

    /// The address of the client's last connection; `None` before it has a client.
    pub(super) fn peer(&self) -> Option<Peer> {
        match &self.client {
            Client::Expected(_) => None,
            Client::Connected(Attachment { peer, .. }) | Client::Away(Absence { peer, .. }) => Some(*peer),
        }
    }

    /// Whether a client has taken the simulation, be it away or not.
    pub(super) fn has_client(&self) -> bool {
        !matches!(self.client, Client::Expected(_))
    }

    fn send(&self, message: ToClient) {
        if let Client::Connected(Attachment { client, .. }) = &self.client {
            client.do_send(message);
        }
    }

    /// Sends the client a text that it must not miss.
    pub(super) fn text(&self, text: String) {
        self.send(ToClient::Text(text));
    }

    /// Sends the client texts that it must not miss.
    pub(super) fn texts(&self, texts: impl IntoIterator<Item = String>) {
        for text in texts {
            self.text(text);
        }
    }

    /// Sends the client a text that is dropped if it can't keep up.
    fn hint(&self, text: String) {
        if let Client::Connected(Attachment { client, .. }) = &self.client {
            client.try_send(ToClient::Text(text)).ok();
        }
    }

    /// Sends the client the reason for a refusal, a failed start or an end.
    fn tell(&self, failure: &Failure) {
        log::info!("{}: {failure} ({})", self.name(), failure.reason);
        self.send(ToClient::Close(failure.clone()));
    }

    /// Releases everything, and sends the client the reason. A client that missed it receives it when it returns.
    pub(super) fn finish(&mut self, failure: Failure, ctx: &mut Context<Self>) {
        if let State::Over(_) = self.state {
            return;
        }
        if let Client::Expected(_) = self.client {
            return self.finish_spare(failure, ctx);
        }
        self.tell(&failure);
        self.state = State::Over(failure);
        self.await_client(ctx);
    }

    /// Reports why the simulation ends, before the state is dropped. Webots' own report takes precedence.
    pub(super) fn report(&self, reason: StopReason) {
        match &self.state {
            State::Waiting { position, .. } => position.end(Failure::from(reason)),
            State::CheckingOut { slot, .. } => slot.end(Failure::from(reason)),
            State::Launching {
                launched: LaunchedSimulation { webots, .. },
                ..
            }
            | State::Ready(ReadySimulation {
                launched: LaunchedSimulation { webots, .. },
                ..
            }) => {
                webots.0.do_send(Stop(reason));
            }
            State::Over(_) => {}
        }
    }

    /// Ends the session without a text to its client, which is not there.
    pub(super) fn leave(&self, reason: StopReason, ctx: &mut Context<Self>) {
        self.report(reason);
        ctx.stop();
    }

    fn reset_controller(&mut self, file: String, ctx: &mut Context<Self>) {
        let launched = self.state.launched_mut();
        let Some((launched, project)) = launched.and_then(|it| it.project.upgrade().map(|project| (it, project)))
        else {
            return self.texts(protocol::failure(&protocol::nothing_to_reset()));
        };
        if std::mem::replace(&mut launched.is_resetting, true) {
            return log::info!("{}: a controller is being reset already", self.name());
        }
        let checkouts = Arc::clone(&self.server.checkouts);
        let restored = async move { checkouts.restore_controller(&project, &file).await.map(|()| file) };
        let restored = restored.into_actor(self).map(|restored, this, _| {
            if let Some(launched) = this.state.launched_mut() {
                launched.is_resetting = false;
            }
            match restored {
                Ok(file) => this.text(protocol::reset_controller(&file)),
                // This error does not end the simulation.
                Err(failure) => this.texts(protocol::failure(&failure)),
            }
        });
        restored.spawn(ctx);
    }

    fn become_ready(&mut self, port: u16, url: String, ctx: &mut Context<Self>) {
        let launched = match std::mem::replace(&mut self.state, State::lost()) {
            State::Launching { launched, .. } => launched,
            // It has ended meanwhile.
            other => return self.state = other,
        };
        self.server.failed_starts.reset();
        let project = launched.project.upgrade();
        self.state = State::Ready(ReadySimulation {
            launched,
            port,
            url,
            idle_end: None,
            is_watched: false,
            arrival: Arrival::Settled,
        });
        match &self.client {
            Client::Expected(Expected { kind, keeper }) => {
                // A Git host may have redirected from the listed world to this one.
                let images = project
                    .zip(self.server.containers.as_ref())
                    .map(|(project, containers)| containers.keep_images_of(&project.url));
                keeper.do_send(SpareEvent::Ready(kind.clone(), images.unwrap_or_default()));
            }
            Client::Connected(_) | Client::Away(_) => self.hand_over(ctx),
        }
    }

    /// The simulation is ready, and has its client: tells it so.
    pub(super) fn hand_over(&mut self, ctx: &mut Context<Self>) {
        self.count("ready");
        let arrival = self.await_viewer(ctx);
        if let State::Ready(ready) = &mut self.state {
            ready.arrival = arrival;
        }
        self.issue_token(ctx);
        self.offer();
    }

    /// Lets the client come back from now on, if it may and has no token yet.
    pub(super) fn issue_token(&mut self, ctx: &mut Context<Self>) {
        if let Client::Connected(Attachment {
            comeback: comeback @ Comeback::OnceReady,
            ..
        }) = &mut self.client
        {
            *comeback = Comeback::With(self.server.sessions.register(ctx.address().recipient()));
            let absence = self.server.config.timing.absence.as_secs();
            // While Webots is busy it sends nothing, and its client would assume a lost connection.
            ctx.run_interval(SIGN_OF_LIFE, move |this, _| this.hint(protocol::absence(absence)));
        }
    }

    /// Sends the client a step of its start.
    pub(super) fn show_progress(&mut self, progress: &Progress) {
        let texts = protocol::progress(progress);
        for text in &texts {
            self.hint(text.clone());
        }
        match &mut self.state {
            State::CheckingOut { progress, .. } => *progress = Some(texts),
            State::Launching { progress, .. } => *progress = texts,
            State::Waiting { .. } | State::Ready(_) | State::Over(_) => {}
        }
    }

    fn exited(&mut self, failure: Failure, ctx: &mut Context<Self>) {
        match self.state {
            State::Ready(_) => self.finish(failure, ctx),
            State::Launching { .. } => self.fail(failure, ctx),
            // The session has ended it; the client knows why.
            State::Over(_) | State::Waiting { .. } | State::CheckingOut { .. } => {}
        }
    }
}

impl Actor for Session {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        closing(self.server.phase.subscribe())
            .into_actor(self)
            .map(|(), this, ctx| {
                this.report(StopReason::ServerStopped);
                this.finish(protocol::stopping(), ctx);
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
                if let Some(LaunchedSimulation { webots, .. }) = self.state.launched() {
                    webots.0.do_send(Keep);
                }
            }
            ClientAction::Leave => self.leave(StopReason::Left, ctx),
            ClientAction::Disconnect => self.await_client(ctx),
        }
    }

    fn finished(&mut self, _: &mut Self::Context) {}
}

impl Handler<SlotEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: SlotEvent, ctx: &mut Self::Context) {
        match event {
            SlotEvent::Granted(port) => match std::mem::replace(&mut self.state, State::lost()) {
                State::Waiting { world, position, .. } => self.check_out(world, None, position.granted(port), ctx),
                // It has ended while it waited.
                other => self.state = other,
            },
            SlotEvent::Queued(position) => {
                if let State::Waiting { ahead, .. } = &mut self.state {
                    *ahead = Some(position);
                }
                self.texts(protocol::queue(position));
            }
            SlotEvent::Watched(is_watched) => {
                if let State::Ready(ready) = &mut self.state {
                    ready.is_watched = is_watched;
                }
                self.text(protocol::watched(is_watched));
                // An administrator is a viewer, too.
                self.settle_arrival(ctx);
            }
            SlotEvent::Viewed => self.settle_arrival(ctx),
            SlotEvent::Pace(slow) => self.hint(protocol::real_time(slow)),
            SlotEvent::Stopped(why) => {
                self.report(StopReason::Administrator);
                self.finish(Failure::new(Reason::StoppedByAdministrator, why), ctx);
            }
            SlotEvent::MakeRoom => {
                let reason = match self.client {
                    Client::Expected(_) => StopReason::Unneeded,
                    Client::Away(_) => StopReason::MakesRoom,
                    // It has come back meanwhile.
                    Client::Connected(_) => return,
                };
                self.report(reason);
                self.finish(reason.into(), ctx);
            }
            SlotEvent::Taken(client, again) => self.taken_by(*client, again, ctx),
        }
    }
}

impl Handler<WebotsEvent> for Session {
    type Result = ();

    fn handle(&mut self, event: WebotsEvent, ctx: &mut Self::Context) {
        match event {
            WebotsEvent::Progress(progress) => self.show_progress(&progress),
            WebotsEvent::Text(text) => {
                let text = protocol::of_project(&text);
                if let State::Launching { launched, .. } = &mut self.state {
                    launched.texts.push(text.clone());
                }
                self.text(text);
            }
            WebotsEvent::Started(at) => {
                if let State::Launching { launched, .. } = &mut self.state {
                    launched.started = Some(at);
                }
                self.text(protocol::shutdown_timeout(self.server.config.timeout));
            }
            WebotsEvent::Ready { port, stream } => {
                let url = self.server.config.stream_url(port, &stream.reveal());
                self.become_ready(port, url, ctx);
            }
            WebotsEvent::Heartbeat => self.hint(protocol::HEARTBEAT.to_owned()),
            WebotsEvent::Hanging(seconds) => self.hint(protocol::hanging(seconds)),
            WebotsEvent::IdleEnd(end) => {
                if let State::Ready(ready) = &mut self.state {
                    ready.idle_end = end;
                }
                self.text(protocol::idle(end.map(seconds_until)));
            }
            WebotsEvent::Exited(failure) => self.exited(failure, ctx),
        }
    }
}
