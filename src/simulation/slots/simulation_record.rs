//! A simulation that has a slot or waits for one: its record, and the events for its session.

use std::net::IpAddr;
use std::sync::{Arc, OnceLock};
use std::time::{Instant, SystemTime};

use actix::{Message, Recipient};
use tokio::sync::Semaphore;

use crate::shared::domain::{Failure, ProjectUrl, Reason, Stage, View};
use crate::shared::http::Peer;
use crate::shared::run::{seconds_since_1970, timestamp};
use crate::shared::text::{excerpt, without_paths};
use crate::simulation::attachment::{NewClient, Token};
use crate::simulation::ends::{End, Ended, lost};
use crate::simulation::snapshot::Simulation;

/// A simulation of this server.
pub(super) struct SimulationRecord {
    /// When its client has asked for it, here or in the line of a session server.
    pub since: Instant,
    /// The number of clients ahead in the queue, as last sent.
    pub sent_position: Option<usize>,
    /// Receives its events.
    pub listener: Recipient<SlotEvent>,
    /// The simulation, as pages show it. It has no port while it is in the queue.
    pub simulation: Simulation,
    /// Whom it runs for.
    pub runs_for: RunsFor,
    /// The address and the user of its client, if their slots are limited, each with its limit.
    pub parties: Vec<(Party, usize)>,
    /// Whether its Webots tells controllers if it has a world; known once it has a stream.
    pub answers_controllers: bool,
    /// The valid tokens for its stream.
    pub accesses: Vec<Access>,
    /// Why the server ends it, once it does, as text for those at its streams.
    pub ending: Arc<OnceLock<String>>,
    /// Since when its client is away, which may come back.
    pub away_since: Option<Instant>,
    /// Whether it was told to make room for a client that waits, and its own has not come back since; or it was kept ready
    /// and ends.
    pub makes_room: bool,
    /// Whether its client was told that it is slower than real time.
    pub is_slow: bool,
    /// Its end, once that is reported. Only the first report counts.
    pub end: Option<End>,
    events: Vec<String>,
}

/// Whom a simulation runs for.
#[derive(Debug)]
pub(super) enum RunsFor {
    /// This client, which counts for its address.
    Client(Peer),
    /// Nobody yet: it is kept ready for a client.
    Spare(Spare),
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
    /// Whether its branch has moved since: no client takes it.
    pub(super) is_outdated: bool,
}

/// An event of a lease.
#[derive(Message)]
#[rtype(result = "()")]
pub enum SlotEvent {
    /// This many clients are ahead in the queue.
    Queued(usize),
    /// This port may be used until the lease is dropped.
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
    /// A client takes the simulation, which was kept ready.
    Taken(Box<NewClient>),
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

/// Number of events that are kept per simulation.
const MAX_EVENTS: usize = 60;
/// Longest text of an event, in characters.
const MAX_EVENT_LENGTH: usize = 500;

impl SimulationRecord {
    /// A simulation that a client has just requested.
    pub(super) fn for_client(simulation: Simulation, client: Peer, listener: Recipient<SlotEvent>) -> Self {
        let event = format!("its client asks for {}", simulation.world);
        Self::with(simulation, RunsFor::Client(client), listener, &event)
    }

    /// A simulation that is kept ready for clients.
    pub(super) fn for_spare(simulation: Simulation, kind: SpareKind, listener: Recipient<SlotEvent>) -> Self {
        let event = format!("it is kept ready, with {}", simulation.world);
        let spare = Spare {
            kind,
            is_outdated: false,
        };
        Self::with(simulation, RunsFor::Spare(spare), listener, &event)
    }

    fn with(simulation: Simulation, runs_for: RunsFor, listener: Recipient<SlotEvent>, event: &str) -> Self {
        let mut record = Self {
            since: Instant::now(),
            sent_position: None,
            listener,
            simulation,
            runs_for,
            parties: Vec::new(),
            answers_controllers: false,
            accesses: Vec::new(),
            ending: Arc::default(),
            away_since: None,
            makes_room: false,
            is_slow: false,
            end: None,
            events: Vec::new(),
        };
        record.note(event);
        record
    }

    /// Its client; `None` if it is kept ready for one.
    pub(super) fn client(&self) -> Option<Peer> {
        match self.runs_for {
            RunsFor::Client(client) => Some(client),
            RunsFor::Spare(_) => None,
        }
    }

    /// The address that its client counts for.
    pub(super) fn address(&self) -> Option<IpAddr> {
        self.client().and_then(Peer::rate_limit_key)
    }

    /// What it is kept ready for; `None` if it has a client.
    pub(super) fn spare(&self) -> Option<&Spare> {
        match &self.runs_for {
            RunsFor::Client(_) => None,
            RunsFor::Spare(spare) => Some(spare),
        }
    }

    /// Whether it has a slot and waits for its client, which has lost its connection.
    pub(super) fn is_away(&self) -> bool {
        self.simulation.port.is_some() && self.away_since.is_some()
    }

    /// Grants it a port.
    pub(super) fn lend(&mut self, port: u16) {
        self.simulation.port = Some(port);
        self.simulation.waited = Some(self.since.elapsed().as_secs_f64());
        self.simulation.stage = Stage::CheckingOut;
        self.note(&format!("it is given port {port}, its world is checked out"));
        self.listener.do_send(SlotEvent::Granted(port));
    }

    /// Adds an event, without paths of the machine. It must not contain an address, because clients may see it in
    /// the output.
    pub(super) fn note(&mut self, event: &str) {
        if self.events.len() < MAX_EVENTS {
            let event = excerpt(&without_paths(event), MAX_EVENT_LENGTH);
            self.events.push(format!("{} {event}", timestamp(SystemTime::now())));
        }
    }

    /// Its end, once its owner has stopped. An owner that has reported none has panicked.
    pub(super) fn ended(mut self) -> Ended {
        let end = self.end.take().unwrap_or_else(|| lost().into());
        self.events.truncate(MAX_EVENTS - 1);
        self.note(&format!("ended ({}): {}", end.failure.reason, end.failure));
        Ended {
            client: self.client(),
            simulation: self.simulation,
            at: seconds_since_1970(),
            events: self.events,
            end,
        }
    }
}
