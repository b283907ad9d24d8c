//! The line of the fleet: passes what happens to it between clients, monitors and the dispatcher. Part of the registry.

use std::collections::{HashMap, HashSet};
use std::net::IpAddr;
use std::time::{Duration, Instant};

use actix::prelude::*;
use prometheus::Histogram;

use super::server_record::{Intake, ServerRecord, ServerState};
use super::server_table::{ServerTable, admission, terms};
use super::slot_link::{LinkChange, LinkEvent};
use crate::session::class::{ClassEntry, ClassState};
use crate::session::line::{
    Dispatcher, Entered, Entry, LineStatus, Moment, Place, Position, Served, Ticket, Turn, WaitingClient,
};
use crate::session::placement::ReadyWorlds;
use crate::shared::domain::{Failure, ProjectUrl, PublicAddress, Reason, ServerReport};
use crate::shared::run::milliseconds_since_1970;

/// Asks for a slot, and waits for it in the line. The answer is the place, unless it is the client's turn already.
#[derive(Message, Debug)]
#[rtype(result = "Result<Option<Place>, Failure>")]
pub struct Wait {
    /// The client's world.
    pub world: ProjectUrl,
    /// The place that the client had.
    pub ticket: Option<Ticket>,
    /// Identifies this wait: those of one connection follow each other.
    pub number: u64,
    /// Receives what happens to the client.
    pub client: Recipient<LineEvent>,
    /// The client's address, if it is known.
    pub from: Option<IpAddr>,
    /// The client's user, if it is known.
    pub user: Option<String>,
    /// The name that the client has chosen.
    pub label: Option<String>,
}

/// This wait is over, if it is not yet. Another one may have its place by now.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct StopWaiting(pub u64);

/// What happens to a client in the line.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct LineEvent {
    /// The wait to which it happens; the client may wait for something else by now.
    pub wait: u64,
    /// What happens.
    pub news: LineNews,
}

/// What happens to a client in the line.
#[derive(Debug)]
pub enum LineNews {
    /// Its place, for which it needs a new ticket.
    Ticket(Place),
    /// How it stands.
    Position(Position),
    /// It is its turn.
    Turn(Turn<PublicAddress>),
    /// Another connection has its place.
    TakenOver,
}

/// A wait, and who receives what happens to its client.
#[derive(Clone)]
struct Waiter {
    wait: u64,
    client: Recipient<LineEvent>,
}

impl Waiter {
    fn tell(&self, news: LineNews) {
        self.client.do_send(LineEvent { wait: self.wait, news });
    }
}

/// The line, and how long clients have waited in it.
pub(super) struct LineKeeper {
    dispatcher: Dispatcher<PublicAddress, Waiter>,
    waited: Histogram,
    /// Whether this server has a key, for which others reserve slots.
    has_key: bool,
    /// The servers to which no link can be opened.
    failed: HashSet<PublicAddress>,
    /// When the clients were last told how they stand.
    told: Instant,
}

/// What is known of each server.
type Records = HashMap<PublicAddress, ServerRecord>;

/// Interval between two looks at who must be told how it stands.
const NEWS: Duration = Duration::from_secs(1);

impl LineKeeper {
    /// Nobody waits. `has_key` is whether this server can ask for reservations. Observes in `waited` how long each client has
    /// waited, in seconds.
    pub(super) fn new(waited: Histogram, has_key: bool) -> Self {
        Self {
            dispatcher: Dispatcher::default(),
            waited,
            has_key,
            failed: HashSet::new(),
            told: Instant::now(),
        }
    }

    /// Whether the free slots of a server with this load, in percent, belong to the line.
    pub(super) fn claims(&self, records: &Records, server: &PublicAddress, load: f64) -> bool {
        self.dispatcher.claims(server, load, admission(records))
    }

    /// A client asks for a slot. What follows is up to [`Self::serve`].
    pub(super) fn enter(&mut self, servers: &ServerTable, wait: Wait) -> Result<Option<Place>, Failure> {
        let refused = servers.refusal(Some(&wait.world));
        if matches!(refused.reason, Reason::RepositoryNotAllowed | Reason::RepositoryBlocked) {
            return Err(refused);
        }
        let client = Waiter {
            wait: wait.number,
            client: wait.client,
        };
        let entry = Entry {
            world: wait.world,
            client: client.clone(),
            wait: wait.number,
            address: wait.from,
            user: wait.user,
            label: wait.label,
        };
        let is_up = |server: &PublicAddress| {
            let state = servers.records.get(server).map(|record| &record.state);
            matches!(
                state,
                Some(ServerState::Answering {
                    intake: Intake::Up | Intake::Full,
                    ..
                })
            )
        };
        let terms = terms(&servers.records);
        let number = rand::random();
        match self
            .dispatcher
            .enter(wait.ticket, entry, number, is_up, terms, moment())
        {
            Entered::Again(turn) => {
                client.tell(LineNews::Turn(turn));
                Ok(None)
            }
            Entered::Waits(place, displaced) => {
                for client in displaced {
                    client.tell(LineNews::TakenOver);
                }
                Ok(Some(place))
            }
        }
    }

    /// A client waits no longer.
    pub(super) fn leave(&mut self, StopWaiting(wait): StopWaiting) {
        self.dispatcher.leave(wait);
    }

    /// Something has happened to the link of a server. What follows is up to [`Self::serve`].
    pub(super) fn link(&mut self, servers: &mut ServerTable, LinkEvent { server, change }: LinkEvent) {
        if !servers.records.contains_key(&server) {
            return;
        }
        match change {
            LinkChange::Up(hello) => {
                self.failed.remove(&server);
                self.dispatcher.link(server, &hello);
            }
            LinkChange::Down => {
                self.failed.remove(&server);
                self.dispatcher.unlink(&server);
            }
            LinkChange::Failed => {
                self.dispatcher.unlink(&server);
                self.failed.insert(server);
            }
            LinkChange::Offers(offers) => {
                let turns = self.dispatcher.offered(&server, &offers, &mut servers.fleet, moment());
                self.give(turns, &mut servers.ready);
            }
        }
    }

    /// A server has reported; `before` is its last report. What follows for those who wait is worked out once for all
    /// servers, with the next tick.
    pub(super) fn reported(&mut self, servers: &ServerTable, server: &PublicAddress, before: Option<&ServerReport>) {
        let record = servers.records.get(server);
        let Some(report) = record.and_then(|record| record.state.report()) else {
            return;
        };
        if let Some(instances) = report.instances {
            self.dispatcher.count_freed(server, instances.freed, Instant::now());
        }
        if !before.is_some_and(|before| before.has_rules_of(report)) {
            self.dispatcher.rules_changed(server, terms(&servers.records));
        }
    }

    /// The fleet consists of these servers now.
    pub(super) fn set_servers(&mut self, servers: &ServerTable) {
        self.dispatcher
            .set_servers(servers.addresses(), terms(&servers.records));
        self.failed.retain(|server| servers.records.contains_key(server));
    }

    /// Looks after what changes with time alone.
    pub(super) fn tick(&mut self, servers: &mut ServerTable) {
        self.serve(servers);
        let now = Instant::now();
        if now.duration_since(self.told) < NEWS {
            return;
        }
        self.told = now;
        self.dispatcher.forget(now);
        for (client, progress) in self.dispatcher.news(now) {
            client.tell(LineNews::Position(progress));
        }
        for (client, place) in self.dispatcher.renewals(now) {
            client.tell(LineNews::Ticket(place));
        }
    }

    /// Who waits.
    pub(super) fn waiting(&self) -> Vec<ClassEntry> {
        let entry = |one: WaitingClient| ClassEntry {
            id: format!("waiting-{:x}", one.place.number),
            server: None,
            world: one.world.to_string(),
            user: one.user.map(str::to_owned),
            label: one.label.map(str::to_owned),
            state: ClassState::Waiting,
            since: one.place.since / 1000,
            waited: None,
            away_until: None,
            cpu: None,
            real_time: None,
        };
        self.dispatcher.waiting().map(entry).collect()
    }

    /// What is known of the line.
    pub(super) fn status(&self) -> LineStatus {
        self.dispatcher.status(moment().unix)
    }

    /// Gives turns, and tells servers who waits, and clients that have just come how they stand.
    pub(super) fn serve(&mut self, servers: &mut ServerTable) {
        let ServerTable {
            records, fleet, ready, ..
        } = servers;
        // Until it can be asked for reservations, a server that makes some gets nobody: its slot might be another's.
        let will_reserve = |server: &PublicAddress| {
            let report = records.get(server).and_then(|record| record.state.report());
            self.has_key && !self.failed.contains(server) && report.is_some_and(|report| report.reserves)
        };
        let now = moment();
        let served = self
            .dispatcher
            .serve(fleet, admission(records), will_reserve, ready, now);
        let Served { turns, wishes } = served;
        self.give(turns, ready);
        for (client, progress) in self.dispatcher.first_news(now.instant) {
            client.tell(LineNews::Position(progress));
        }
        for (server, wishes) in wishes {
            servers.ask(&server, wishes);
        }
    }

    fn give(&self, turns: Vec<(Waiter, Turn<PublicAddress>)>, ready: &mut ReadyWorlds<PublicAddress>) {
        for (client, turn) in turns {
            ready.place(&turn.server, &turn.world, Instant::now());
            self.waited.observe(turn.waited.as_secs_f64());
            client.tell(LineNews::Turn(turn));
        }
    }
}

fn moment() -> Moment {
    Moment {
        instant: Instant::now(),
        unix: milliseconds_since_1970(),
    }
}
