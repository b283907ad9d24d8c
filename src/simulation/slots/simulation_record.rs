//! A simulation that has a slot or waits for one: its record, what pages show of it, and the events for its session.

use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use std::time::{Instant, SystemTime};

use actix::{Message, Recipient};
use tokio::sync::Semaphore;

use crate::shared::domain::{Failure, ProjectUrl, Reason, ReservationId, Stage, View};
use crate::shared::http::Peer;
use crate::shared::run::{seconds_since_1970, timestamp};
use crate::shared::text::{excerpt, without_paths};
use crate::simulation::attachment::{NewClient, Token};
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::{End, Ended, lost};
use crate::simulation::simulated_time::SimulatedTime;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::{SceneKind, Simulation};

/// A simulation of this server. [`SimulationRecord::shown`] is what pages and programs see of it.
pub(super) struct SimulationRecord {
    /// Its id; unique.
    pub id: SimulationId,
    /// The world's URL.
    pub world: String,
    /// The URL of its repository.
    repository: String,
    /// When it was requested, or taken by its client if it was kept ready, in seconds since 1970.
    requested: u64,
    /// Receives its events.
    pub listener: Recipient<SlotEvent>,
    /// How far it has come, and whom it is for.
    pub standing: Standing,
    /// How fast it runs.
    pub time: SimulatedTime,
    /// Why the server ends it, once it does, as text for those at its streams.
    pub ending: Arc<OnceLock<String>>,
    /// Its end, once that is reported. Only the first report counts.
    pub end: Option<End>,
    events: Vec<String>,
}

/// Whether a simulation has a slot.
pub(super) enum Standing {
    /// It is in the queue, always for a client. `told`: the number of clients ahead, as it was last sent.
    Waiting { client: Client, told: Option<usize> },
    /// It has a slot.
    Holding(Holding),
}

/// What a simulation has with its slot.
pub(super) struct Holding {
    /// The port of the slot.
    pub port: u16,
    /// Whom it runs for.
    pub runs_for: RunsFor,
    /// How far it has come.
    pub state: HoldingState,
}

/// A client that has a simulation, or waits for one.
#[derive(Debug, Clone)]
pub(super) struct Client {
    /// Its address.
    pub peer: Peer,
    /// Who it is.
    pub identity: ClientIdentity,
    /// The address and the user that its slot counts for, if their slots are limited, each with its limit.
    pub parties: Vec<(Party, usize)>,
    /// When it has come, here or in the line of a session server.
    pub since: Instant,
    /// Set while it has no connection, and may come back.
    pub away: Option<Away>,
}

/// The absence of a client that may come back.
#[derive(Debug, Clone, Copy)]
pub(super) struct Away {
    pub since: Instant,
    /// When its simulation stops waiting for it, in seconds since 1970.
    pub until: u64,
    /// Whether the simulation was told to make room for a client that waits.
    pub makes_room: bool,
}

/// Whom a simulation runs for.
pub(super) enum RunsFor {
    /// A client, which counts for its address.
    Client(Served),
    /// Nobody yet: it is kept ready for a client.
    Spare(Spare),
}

/// A client whose simulation has a slot.
pub(super) struct Served {
    pub client: Client,
    /// Seconds for which it has waited for the slot.
    pub waited: f64,
    /// Whether it was told that its simulation is slower than real time.
    pub knows_slow: bool,
    /// Set while it takes a simulation that was kept ready, until the session knows: should the simulation have failed, its
    /// slot is reserved under this id, with which the client starts another one.
    pub arriving: Option<ReservationId>,
}

/// How far a simulation that has a slot has come.
pub(super) enum HoldingState {
    /// Its world is checked out.
    CheckingOut,
    /// Its Webots is prepared, for example its containers.
    Preparing(Prepared),
    /// Its Webots was launched.
    Launched(Launch),
}

/// What is known of a simulation once its world is checked out.
#[derive(Debug, Clone)]
pub struct Prepared {
    /// The version of Webots that the world was made for.
    pub version: String,
    /// The 3D scene that its Webots streams; `None` for a video.
    pub scene: Option<SceneKind>,
    /// The number of its GPU, if simulations are spread over several.
    pub gpu: Option<u32>,
}

/// The Webots of a simulation.
pub(super) struct Launch {
    prepared: Prepared,
    /// When its time limit has begun, in seconds since 1970.
    at: u64,
    /// The root of its process tree.
    pid: i32,
    /// The file that its output is kept in.
    log: Option<PathBuf>,
    pub phase: Phase,
}

/// The state of a Webots that was launched.
pub(super) enum Phase {
    /// It is not ready.
    Launching,
    /// Viewers may connect. `is_running`: the simulation is not paused.
    Ready { stream: OpenStream, is_running: bool },
    /// It ends. Its stream is there until the end is reported.
    Stopping(Option<OpenStream>),
}

/// The stream of a simulation.
pub(super) struct OpenStream {
    /// Whether its Webots tells controllers if it has a world.
    pub answers_controllers: bool,
    /// The valid tokens.
    pub accesses: Vec<Access>,
}

/// What a simulation without a client is kept ready for: any client that asks for this can take it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SpareKind {
    /// The world.
    pub world: ProjectUrl,
    /// How it is shown.
    pub view: View,
}

/// A simulation without a client.
#[derive(Debug)]
pub(super) struct Spare {
    pub(super) kind: SpareKind,
    pub(super) state: SpareState,
}

/// Whether a client may take a simulation that is kept ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SpareState {
    /// It may.
    Current,
    /// Its branch has moved since: no client takes it.
    Outdated,
    /// It ends.
    Ending,
}

/// An event of a simulation, for its session.
#[derive(Message)]
#[rtype(result = "()")]
pub enum SlotEvent {
    /// This many clients are ahead in the queue.
    Queued(usize),
    /// It has a slot, with this port: its position in the queue becomes a [`Slot`](super::Slot).
    Granted(u16),
    /// The first administrator who watches the simulation connects, or the last one leaves.
    Watched(bool),
    /// A viewer opens its stream through this server.
    Viewed,
    /// The simulation runs this fast, and slower than real time; `None`: it is not slow any more.
    Pace(Option<f64>),
    /// The administrator stops the simulation; the text is for its client.
    Stopped(String),
    /// Another client waits for a slot, and the client of this one has been away for too long; or the
    /// simulation was kept ready, and is not needed.
    MakeRoom,
    /// A client takes the simulation, which was kept ready. If that has failed, the client starts another one with this
    /// reservation.
    Taken(Box<NewClient>, ReservationId),
}

/// Access to the stream of a simulation.
pub(super) struct Access {
    pub token: Token,
    pub holder: Holder,
    /// Limits the connections.
    pub connections: Arc<Semaphore>,
}

/// Limit of connections with one token: a viewer has one, and for some time the ones from before its page was reloaded.
const MAX_CONNECTIONS: usize = 8;

impl Access {
    /// A new token.
    pub(super) fn new(holder: Holder) -> Self {
        Self {
            token: Token::random(),
            holder,
            connections: Arc::new(Semaphore::new(MAX_CONNECTIONS)),
        }
    }
}

/// The holder of a token for the stream of a simulation.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Holder {
    /// The client of the simulation.
    Client,
    /// An administrator who will watch, and has not connected yet. The token admits one connection.
    Invited,
    /// An administrator who watches. The token is valid as long as that connection.
    Watcher,
}

/// Clients that share a limit of slots: those of one address, or of one user, whom a trusted reverse proxy names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Party {
    Address(IpAddr),
    User(String),
}

impl Party {
    /// Why it gets no other slot: it has `slots`, and `waiting` of its clients wait.
    pub(super) fn refusal(&self, slots: usize, waiting: usize) -> Failure {
        let have = match self {
            Self::Address(_) => "Clients of your address have",
            Self::User(_) => "You have",
        };
        let message = format!(
            "{have} {slots} places of this simulation server, and {waiting} more are waiting. The rest is kept for \
             others. Try again later"
        );
        Failure::new(Reason::ShareUsed, message)
    }
}

impl Client {
    /// A client that has just come. The pool knows what its slot counts for.
    pub(super) fn new(peer: Peer, identity: ClientIdentity) -> Self {
        Self {
            peer,
            identity,
            parties: Vec::new(),
            since: Instant::now(),
            away: None,
        }
    }

    /// The address that it counts for.
    pub(super) fn address(&self) -> Option<IpAddr> {
        self.peer.rate_limit_key()
    }
}

/// Number of events that are kept per simulation.
const MAX_EVENTS: usize = 60;
/// Longest text of an event, in characters.
const MAX_EVENT_LENGTH: usize = 500;

impl SimulationRecord {
    /// A simulation that a client has just requested.
    pub(super) fn for_client(
        id: SimulationId,
        world: &ProjectUrl,
        client: Client,
        listener: Recipient<SlotEvent>,
    ) -> Self {
        let standing = Standing::Waiting { client, told: None };
        let event = format!("its client asks for {world}");
        Self::with(id, world, standing, listener, &event)
    }

    /// A simulation that is kept ready for clients, on this port.
    pub(super) fn for_spare(id: SimulationId, kind: SpareKind, port: u16, listener: Recipient<SlotEvent>) -> Self {
        let world = kind.world.clone();
        let spare = Spare {
            kind,
            state: SpareState::Current,
        };
        let standing = Standing::Holding(Holding {
            port,
            runs_for: RunsFor::Spare(spare),
            state: HoldingState::CheckingOut,
        });
        let event = format!("it is kept ready, with {world}");
        let mut record = Self::with(id, &world, standing, listener, &event);
        record.note_port(port);
        record
    }

    fn with(
        id: SimulationId,
        world: &ProjectUrl,
        standing: Standing,
        listener: Recipient<SlotEvent>,
        event: &str,
    ) -> Self {
        let mut record = Self {
            id,
            world: world.to_string(),
            repository: world.repository(),
            requested: seconds_since_1970(),
            listener,
            standing,
            time: SimulatedTime::default(),
            ending: Arc::default(),
            end: None,
            events: Vec::new(),
        };
        record.note(event);
        record
    }

    /// Its client in the queue; `None` if it has a slot.
    pub(super) fn waiting(&self) -> Option<&Client> {
        match &self.standing {
            Standing::Waiting { client, .. } => Some(client),
            Standing::Holding(_) => None,
        }
    }

    /// What it has with its slot; `None` if it waits for one.
    pub(super) fn holding(&self) -> Option<&Holding> {
        match &self.standing {
            Standing::Waiting { .. } => None,
            Standing::Holding(holding) => Some(holding),
        }
    }

    fn holding_mut(&mut self) -> Option<&mut Holding> {
        match &mut self.standing {
            Standing::Waiting { .. } => None,
            Standing::Holding(holding) => Some(holding),
        }
    }

    /// Its client, if it has one and a slot.
    pub(super) fn served(&self) -> Option<&Served> {
        match &self.holding()?.runs_for {
            RunsFor::Client(served) => Some(served),
            RunsFor::Spare(_) => None,
        }
    }

    /// The same, to change it.
    pub(super) fn served_mut(&mut self) -> Option<&mut Served> {
        match &mut self.holding_mut()?.runs_for {
            RunsFor::Client(served) => Some(served),
            RunsFor::Spare(_) => None,
        }
    }

    /// Its client; `None` if it is kept ready for one.
    pub(super) fn client(&self) -> Option<&Client> {
        self.waiting().or_else(|| Some(&self.served()?.client))
    }

    /// What it is kept ready for; `None` if it has a client.
    pub(super) fn spare(&self) -> Option<&Spare> {
        match &self.holding()?.runs_for {
            RunsFor::Client(_) => None,
            RunsFor::Spare(spare) => Some(spare),
        }
    }

    /// The same, to change it.
    pub(super) fn spare_mut(&mut self) -> Option<&mut Spare> {
        match &mut self.holding_mut()?.runs_for {
            RunsFor::Client(_) => None,
            RunsFor::Spare(spare) => Some(spare),
        }
    }

    /// The absence of its client, if it has a slot, and waits for that client.
    pub(super) fn away(&self) -> Option<Away> {
        self.served()?.client.away
    }

    /// Whether it ends because somebody else needs its slot.
    pub(super) fn makes_room(&self) -> bool {
        let ends = self.spare().is_some_and(|spare| spare.state == SpareState::Ending);
        ends || self.away().is_some_and(|away| away.makes_room)
    }

    /// Records until when its client, which has gone, may come back; `None`: it is there, and keeps its simulation, also one
    /// that was to make room.
    pub(super) fn set_away(&mut self, until: Option<u64>) {
        let client = match &mut self.standing {
            Standing::Waiting { client, .. } => client,
            Standing::Holding(Holding {
                runs_for: RunsFor::Client(served),
                ..
            }) => &mut served.client,
            // Nobody is away who never was there.
            Standing::Holding(_) => return,
        };
        client.away = until.map(|until| Away {
            since: Instant::now(),
            until,
            makes_room: false,
        });
    }

    /// Grants it a port, if it waits for one.
    pub(super) fn lend(&mut self, port: u16) {
        let Some(client) = self.waiting().cloned() else {
            return self.refuse("a slot");
        };
        self.standing = Standing::Holding(Holding {
            port,
            runs_for: RunsFor::Client(Served {
                waited: client.since.elapsed().as_secs_f64(),
                client,
                knows_slow: false,
                arriving: None,
            }),
            state: HoldingState::CheckingOut,
        });
        self.note_port(port);
        self.listener.do_send(SlotEvent::Granted(port));
    }

    fn note_port(&mut self, port: u16) {
        self.note(&format!("it is given port {port}, its world is checked out"));
    }

    /// A client takes it, which was kept ready. Its time limit begins now.
    pub(super) fn take(&mut self, client: Client, reservation: ReservationId) {
        let now = seconds_since_1970();
        let Some(holding) = self.holding_mut() else {
            return self.refuse("a client that takes it");
        };
        if let HoldingState::Launched(launch) = &mut holding.state {
            launch.at = now;
        }
        holding.runs_for = RunsFor::Client(Served {
            waited: client.since.elapsed().as_secs_f64(),
            client,
            knows_slow: false,
            arriving: Some(reservation),
        });
        self.requested = now;
        self.note("a client takes it; it was kept ready");
    }

    /// Its world is checked out.
    pub(super) fn prepare(&mut self, prepared: Prepared) {
        if let Some(Holding {
            state: state @ HoldingState::CheckingOut,
            ..
        }) = self.holding_mut()
        {
            *state = HoldingState::Preparing(prepared);
        } else {
            self.refuse("a checkout that is done");
        }
    }

    /// Its Webots was launched as this process, and its output is kept in this file.
    pub(super) fn launch(&mut self, pid: i32, log: Option<PathBuf>) {
        if let Some(Holding { state, .. }) = self.holding_mut()
            && let HoldingState::Preparing(prepared) = state
        {
            *state = HoldingState::Launched(Launch {
                prepared: prepared.clone(),
                at: seconds_since_1970(),
                pid,
                log,
                phase: Phase::Launching,
            });
        } else {
            self.refuse("a launch");
        }
    }

    fn phase_mut(&mut self) -> Option<&mut Phase> {
        match &mut self.holding_mut()?.state {
            HoldingState::Launched(launch) => Some(&mut launch.phase),
            HoldingState::CheckingOut | HoldingState::Preparing(_) => None,
        }
    }

    /// Opens its stream: it is ready.
    pub(super) fn open_stream(&mut self, stream: OpenStream, is_running: bool) {
        if let Some(phase @ Phase::Launching) = self.phase_mut() {
            *phase = Phase::Ready { stream, is_running };
            self.time.set_running(is_running);
        } else {
            self.refuse("a stream");
        }
    }

    /// The simulation is paused, or goes on.
    pub(super) fn set_running(&mut self, now: bool) {
        if let Some(Phase::Ready { is_running, .. }) = self.phase_mut() {
            *is_running = now;
            self.time.set_running(now);
        }
    }

    /// Its Webots ends.
    pub(super) fn stop(&mut self) {
        if let Some(phase) = self.phase_mut() {
            let stream = match std::mem::replace(phase, Phase::Stopping(None)) {
                Phase::Launching => None,
                Phase::Ready { stream, .. } => Some(stream),
                Phase::Stopping(stream) => stream,
            };
            *phase = Phase::Stopping(stream);
        }
        self.time.set_running(false);
    }

    /// It has ended. Its tokens become invalid, because another simulation may soon have its port.
    pub(super) fn end(&mut self, end: End) {
        if let Some(phase) = self.phase_mut() {
            *phase = Phase::Stopping(None);
        }
        self.time.set_running(false);
        self.end.get_or_insert(end);
    }

    /// Its stream, if that is open.
    pub(super) fn stream(&self) -> Option<&OpenStream> {
        match &self.holding()?.state {
            HoldingState::Launched(Launch {
                phase: Phase::Ready { stream, .. } | Phase::Stopping(Some(stream)),
                ..
            }) => Some(stream),
            HoldingState::CheckingOut | HoldingState::Preparing(_) | HoldingState::Launched(_) => None,
        }
    }

    /// The same, to change it.
    pub(super) fn stream_mut(&mut self) -> Option<&mut OpenStream> {
        match self.phase_mut()? {
            Phase::Ready { stream, .. } | Phase::Stopping(Some(stream)) => Some(stream),
            Phase::Launching | Phase::Stopping(None) => None,
        }
    }

    /// The transition is none of its state: its owners, which report each of their steps once and in order, have a fault.
    fn refuse(&self, what: &str) {
        log::error!("{}: in the state {:?} it does not expect {what}", self.id, self.stage());
    }

    /// Its state, as pages and programs see it.
    pub(super) fn stage(&self) -> Stage {
        match &self.standing {
            Standing::Waiting { .. } => Stage::Queued,
            Standing::Holding(holding) => match &holding.state {
                HoldingState::CheckingOut | HoldingState::Preparing(_) => Stage::CheckingOut,
                HoldingState::Launched(launch) => match launch.phase {
                    Phase::Launching => Stage::Launching,
                    Phase::Ready { is_running: true, .. } => Stage::Running,
                    Phase::Ready { is_running: false, .. } => Stage::Idle,
                    Phase::Stopping(_) => Stage::Stopping,
                },
            },
        }
    }

    /// The simulation, as pages and programs see it.
    pub(super) fn shown(&self) -> Simulation {
        let client = self.client();
        let holding = self.holding();
        let (prepared, launch) = match holding.map(|holding| &holding.state) {
            None | Some(HoldingState::CheckingOut) => (None, None),
            Some(HoldingState::Preparing(prepared)) => (Some(prepared), None),
            Some(HoldingState::Launched(launch)) => (Some(&launch.prepared), Some(launch)),
        };
        Simulation {
            id: self.id,
            world: self.world.clone(),
            repository: self.repository.clone(),
            identity: client.map(|client| client.identity.clone()).unwrap_or_default(),
            stage: self.stage(),
            since: self.requested,
            launched: launch.map(|launch| launch.at),
            pid: launch.map(|launch| launch.pid),
            port: holding.map(|holding| holding.port),
            waited: self.served().map(|served| served.waited),
            gpu: prepared.and_then(|prepared| prepared.gpu),
            away_until: client.and_then(|client| client.away).map(|away| away.until),
            version: prepared.map(|prepared| prepared.version.clone()),
            scene: prepared.and_then(|prepared| prepared.scene),
            time: self.time.clone(),
            log: launch.and_then(|launch| launch.log.clone()),
        }
    }

    /// Adds an event, without paths of the machine. It must not contain an address, because clients may see it in
    /// the output.
    pub(super) fn note(&mut self, event: &str) {
        if self.events.len() < MAX_EVENTS {
            let event = excerpt(&without_paths(event), MAX_EVENT_LENGTH);
            self.events.push(format!("{} {event}", timestamp(SystemTime::now())));
        }
    }

    /// Its end, once its owner has stopped. An owner that has reported none has panicked. It was no client's if it has failed
    /// before its session knew of one, which starts another.
    pub(super) fn ended(mut self) -> Ended {
        let end = self.end.take().unwrap_or_else(|| lost().into());
        self.events.truncate(MAX_EVENTS - 1);
        self.note(&format!("ended ({}): {}", end.failure.reason, end.failure));
        let is_known = self.served().is_none_or(|served| served.arriving.is_none());
        Ended {
            client: self.client().filter(|_| is_known).map(|client| client.peer),
            simulation: self.shown(),
            at: seconds_since_1970(),
            events: self.events,
            end,
        }
    }
}
