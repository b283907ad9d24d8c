//! Actor: owns the fleet's state and the subscribers; answers picks; pushes changes.
//!
//! One for the whole server, created at start; it never ends. It alone decides availability: it hears of every report
//! and of every pick, so that a pick counts at once. It makes a monitor for each simulation server, and a new one if
//! a monitor has panicked.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;

use super::config::SessionConfig;
use super::fleet_status::{FleetStatus, ServerStatus, State, StateChange};
use super::notices::{Event, Notice};
use super::placement::{self, Fleet, Policy};
use super::server_monitor::{Forget, Reported, ServerMonitor, Unreachable, Watch};
use crate::shared::address::PublicAddress;
use crate::shared::project_url::{NoProject, ProjectUrl};
use crate::shared::status::Dispatch;

/// Whether some simulation server can take a client.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct Availability(pub bool);

/// Asks to be told of availability, now and whenever it changes.
#[derive(Message)]
#[rtype(result = "Subscription")]
pub struct Subscribe(pub Recipient<Availability>);

/// A place among the subscribers. Dropping it gives it up.
#[derive(Debug)]
pub struct Subscription {
    id: u64,
    registry: Addr<Registry>,
}

/// Asks for a simulation server: the least loaded that will run this world.
#[derive(Message, Debug)]
#[rtype(result = "Result<PublicAddress, NoServer>")]
pub struct Pick {
    /// The world, where one is named.
    pub world: Option<ProjectUrl>,
}

/// No simulation server is given. The words are those of the protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoServer {
    /// None has room.
    #[error("Error: no simulation server available at the moment.")]
    Unavailable,
    /// None runs worlds of this repository.
    #[error("Error: no simulation server accepts {0}.")]
    NotAccepted(String),
    /// The world's URL is none.
    #[error("Error: {0}")]
    NoWorld(NoProject),
}

/// Asks for everything that is known.
#[derive(Message)]
#[rtype(result = "Arc<FleetStatus>")]
pub struct GetStatus;

/// Asks for availability alone.
#[derive(Message)]
#[rtype(result = "bool")]
pub struct IsAvailable;

/// Gives another configuration: its simulation servers and thresholds count from now on.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Reconfigure(pub Arc<SessionConfig>);

#[derive(Message)]
#[rtype(result = "()")]
struct Unsubscribe(u64);

/// The actor.
pub struct Registry {
    config: Arc<SessionConfig>,
    client: awc::Client,
    notices: Option<Recipient<Notice>>,
    latencies: prometheus::Histogram,
    fleet: Fleet<PublicAddress>,
    servers: BTreeMap<PublicAddress, Watched>,
    subscribers: HashMap<u64, Subscriber>,
    last_subscriber: u64,
    /// Whether some subscribers could not be told the last change.
    behind: bool,
    available: bool,
    changes: VecDeque<StateChange>,
}

struct Watched {
    monitor: Addr<ServerMonitor>,
    drained: bool,
    state: State,
    since: SystemTime,
    report: Option<Dispatch>,
    error: Option<Unreachable>,
    latency: Option<Duration>,
    answered: Option<Instant>,
}

struct Subscriber {
    client: Recipient<Availability>,
    told: Option<bool>,
}

/// How many changes of state are kept.
const CHANGES: usize = 50;
/// Between two looks at what changes without a report: placements that expire, monitors that are gone.
const LOOK: Duration = Duration::from_millis(250);
/// How long a client that came needs until its load shows: the start, and the mean of five seconds.
const SETTLING: Duration = Duration::from_secs(8);

impl Pick {
    /// Reads what a client wants: nothing in particular, or a world.
    ///
    /// # Errors
    /// When the URL is none.
    pub fn parse(world: Option<&str>) -> Result<Self, NoServer> {
        let world = world.filter(|text| !text.is_empty()).map(ProjectUrl::parse).transpose();
        world.map(|world| Self { world }).map_err(NoServer::NoWorld)
    }
}

impl Registry {
    /// Prepares the registry; its monitors start with it.
    #[must_use]
    pub fn new(
        config: Arc<SessionConfig>,
        notices: Option<Recipient<Notice>>,
        latencies: prometheus::Histogram,
    ) -> Self {
        let idle = (config.load_refresh * 3).max(Duration::from_secs(15));
        // One connection for each simulation server; the default limit of the pool is 100.
        let connector = awc::Connector::new().limit(0).conn_keep_alive(idle).timeout(config.timing.answer);
        let client = awc::Client::builder().connector(connector).timeout(config.timing.answer).disable_redirects();
        Self {
            fleet: Fleet::new(policy(&config)),
            client: client.finish(),
            config,
            notices,
            latencies,
            servers: BTreeMap::new(),
            subscribers: HashMap::new(),
            last_subscriber: 0,
            behind: false,
            available: false,
            changes: VecDeque::new(),
        }
    }

    /// Starts monitors for new servers and ends those of servers that are no longer listed.
    fn apply(&mut self, ctx: &mut Context<Self>) {
        let listed = self.config.simulation_servers.clone();
        let gone: Vec<PublicAddress> = self.servers.keys().filter(|known| !listed.contains(known)).cloned().collect();
        for address in gone {
            log::info!("{address}: no longer watched");
            self.fleet.remove(&address);
            if let Some(watched) = self.servers.remove(&address) {
                watched.monitor.do_send(Forget);
            }
        }
        for address in listed {
            let drained = self.config.drained_servers.contains(&address);
            if let Some(watched) = self.servers.get_mut(&address) {
                watched.drained = drained;
                continue;
            }
            let monitor = self.monitor(&address, ctx);
            self.fleet.add(address.clone());
            let watched = Watched {
                monitor,
                drained,
                state: State::Unknown,
                since: SystemTime::now(),
                report: None,
                error: None,
                latency: None,
                answered: None,
            };
            self.servers.insert(address, watched);
        }
        self.publish();
    }

    fn monitor(&self, address: &PublicAddress, ctx: &mut Context<Self>) -> Addr<ServerMonitor> {
        let SessionConfig { load_refresh: refresh, ssl, ref timing, .. } = *self.config;
        let watch = Watch { refresh, patience: timing.answer, ssl };
        ServerMonitor::new(address.clone(), watch, self.client.clone(), ctx.address().recipient()).start()
    }

    /// What happens without a message.
    fn look(&mut self, ctx: &mut Context<Self>) {
        let gone = |watched: &Watched| !watched.monitor.connected();
        let lost: Vec<PublicAddress> =
            self.servers.iter().filter(|(_, watched)| gone(watched)).map(|(address, _)| address.clone()).collect();
        for address in lost {
            log::error!("{address}: its monitor is gone, a new one is started");
            let monitor = self.monitor(&address, ctx);
            if let Some(watched) = self.servers.get_mut(&address) {
                watched.monitor = monitor;
            }
        }
        self.publish();
    }

    /// Tells the subscribers, if availability has changed; those who could not be told last time are told now.
    fn publish(&mut self) {
        let available = self.fleet.available(Instant::now());
        if available != self.available {
            log::info!(
                "{}",
                if available { "a simulation server is available" } else { "no simulation server is available" }
            );
            self.available = available;
        } else if !self.behind {
            return;
        }
        self.subscribers.retain(|_, subscriber| subscriber.tell(available));
        self.behind = self.subscribers.values().any(|subscriber| subscriber.told != Some(available));
    }

    fn changed(&mut self, server: &PublicAddress, before: State, after: State, why: &str) {
        let at = SystemTime::now();
        match after {
            State::Down => log::warn!("{server}: {}: {why}", after.word()),
            _ => log::info!("{server}: {}: {why}", after.word()),
        }
        if self.changes.len() == CHANGES {
            self.changes.pop_back();
        }
        self.changes.push_front(StateChange { at, server: server.clone(), state: after, why: why.to_owned() });
        let Some(event) = event(before, after) else {
            return;
        };
        let watched = self.servers.get(server);
        let load = watched.and_then(|watched| watched.report.as_ref()).map(|report| report.load);
        let load = load.filter(|_| after != State::Down);
        let error = watched.and_then(|watched| watched.error.as_ref()).map(ToString::to_string);
        let notice = Notice { server: server.clone(), event, load, error, at };
        if let Some(notices) = &self.notices
            && let Err(lost) = notices.try_send(notice)
        {
            log::error!("{server}: no notice is sent: {lost}");
        }
    }

    fn state_of(&self, report: &Dispatch, drained: bool) -> State {
        let no_place = report.instances.is_some_and(|instances| instances.present() >= instances.places);
        if drained || report.draining {
            State::Draining
        } else if report.load.percent() >= self.config.load_threshold || no_place {
            State::Full
        } else {
            State::Up
        }
    }

    fn good_answer(&mut self, server: &PublicAddress, report: Dispatch) {
        let now = Instant::now();
        let Some(drained) = self.servers.get(server).map(|watched| watched.drained) else {
            return;
        };
        let state = self.state_of(&report, drained);
        let accepting = state != State::Draining;
        let instances = report.instances.map(|instances| placement::Instances {
            present: instances.present(),
            places: instances.places,
            arrivals: instances.arrivals,
            accepting,
        });
        // A server that counts nothing can still be drained here.
        let drained_without_counts = instances.is_none() && !accepting;
        if drained_without_counts {
            self.fleet.lose(server);
        } else {
            self.fleet.report(server, now, placement::Report { load: report.load.percent(), instances });
        }
        let why = format!("load {:.1} %", report.load.percent());
        self.enter(server, state, &why, |watched| {
            watched.report = Some(report);
            watched.error = None;
            watched.answered = Some(now);
        });
    }

    fn bad_answer(&mut self, server: &PublicAddress, error: Unreachable) {
        self.fleet.lose(server);
        let why = error.to_string();
        self.enter(server, State::Down, &why, |watched| watched.error = Some(error));
    }

    fn enter(&mut self, server: &PublicAddress, state: State, why: &str, change: impl FnOnce(&mut Watched)) {
        let Some(watched) = self.servers.get_mut(server) else {
            return;
        };
        change(watched);
        let before = std::mem::replace(&mut watched.state, state);
        if before != state {
            watched.since = SystemTime::now();
            self.changed(server, before, state, why);
        }
    }

    fn status_of(&self, address: &PublicAddress, now: Instant) -> Option<ServerStatus> {
        let watched = self.servers.get(address)?;
        Some(ServerStatus {
            address: address.clone(),
            state: watched.state,
            since: watched.since,
            report: watched.report.clone(),
            error: watched.error.as_ref().map(ToString::to_string),
            effective_load: self.fleet.effective_load(address, now),
            in_flight: self.fleet.in_flight(address, now),
            client_cost: self.fleet.learned_cost(address),
            latency: watched.latency,
            answered: watched.answered,
        })
    }
}

impl Subscriber {
    /// Tells the value unless it was told last; false when nobody listens any more.
    fn tell(&mut self, available: bool) -> bool {
        if self.told == Some(available) {
            return true;
        }
        match self.client.try_send(Availability(available)) {
            Ok(()) => self.told = Some(available),
            // Its mailbox is full: it is told at the next look what is true then.
            Err(SendError::Full(_)) => {}
            Err(SendError::Closed(_)) => return false,
        }
        true
    }
}

fn policy(config: &SessionConfig) -> Policy {
    Policy {
        threshold: config.load_threshold,
        initial_cost: config.client_cost,
        patience: config.timing.placement,
        settling: SETTLING,
    }
}

/// What the administrator is told of a change, as the original does.
fn event(before: State, after: State) -> Option<Event> {
    match (before, after) {
        (_, State::Down) => Some(Event::NotResponding),
        (State::Down, _) => Some(Event::WorkingAgain),
        (_, State::Full) => Some(Event::MaximumLoad),
        (State::Full, State::Up) => Some(Event::AvailableAgain),
        _ => None,
    }
}

impl Actor for Registry {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // Every monitor may report in the same moment.
        ctx.set_mailbox_capacity(4096);
        self.apply(ctx);
        ctx.run_interval(LOOK, Self::look);
    }
}

impl Handler<Reported> for Registry {
    type Result = ();

    fn handle(&mut self, report: Reported, _: &mut Self::Context) {
        let Reported { server, latency, answer } = report;
        self.latencies.observe(latency.as_secs_f64());
        if let Some(watched) = self.servers.get_mut(&server) {
            watched.latency = Some(latency);
        }
        match answer {
            Ok(dispatch) => self.good_answer(&server, dispatch),
            Err(error) => self.bad_answer(&server, error),
        }
        self.publish();
    }
}

impl Handler<Pick> for Registry {
    type Result = Result<PublicAddress, NoServer>;

    fn handle(&mut self, Pick { world }: Pick, _: &mut Self::Context) -> Self::Result {
        let servers = &self.servers;
        let accepts = |address: &PublicAddress, world: &ProjectUrl| {
            servers.get(address).and_then(|watched| watched.report.as_ref()).is_none_or(|report| report.accepts(world))
        };
        let eligible = |address: &PublicAddress| world.as_ref().is_none_or(|world| accepts(address, world));
        let picked = self.fleet.place(Instant::now(), eligible);
        let answer = picked.ok_or_else(|| match &world {
            Some(world) if !servers.keys().any(|address| accepts(address, world)) => {
                NoServer::NotAccepted(world.repository())
            }
            _ => NoServer::Unavailable,
        });
        self.publish();
        answer
    }
}

impl Handler<Subscribe> for Registry {
    type Result = MessageResult<Subscribe>;

    fn handle(&mut self, Subscribe(client): Subscribe, ctx: &mut Self::Context) -> Self::Result {
        self.last_subscriber += 1;
        let id = self.last_subscriber;
        let mut subscriber = Subscriber { client, told: None };
        if subscriber.tell(self.available) {
            self.behind |= subscriber.told.is_none();
            self.subscribers.insert(id, subscriber);
        }
        MessageResult(Subscription { id, registry: ctx.address() })
    }
}

impl Handler<Unsubscribe> for Registry {
    type Result = ();

    fn handle(&mut self, Unsubscribe(id): Unsubscribe, _: &mut Self::Context) {
        self.subscribers.remove(&id);
    }
}

impl Handler<IsAvailable> for Registry {
    type Result = bool;

    fn handle(&mut self, _: IsAvailable, _: &mut Self::Context) -> bool {
        self.available
    }
}

impl Handler<GetStatus> for Registry {
    type Result = MessageResult<GetStatus>;

    fn handle(&mut self, _: GetStatus, _: &mut Self::Context) -> Self::Result {
        let now = Instant::now();
        let servers = self.config.simulation_servers.iter().filter_map(|address| self.status_of(address, now));
        MessageResult(Arc::new(FleetStatus {
            available: self.available,
            clients: self.subscribers.len(),
            mean_load: self.fleet.mean_load(),
            servers: servers.collect(),
            changes: self.changes.clone(),
        }))
    }
}

impl Handler<Reconfigure> for Registry {
    type Result = ();

    fn handle(&mut self, Reconfigure(config): Reconfigure, ctx: &mut Self::Context) {
        self.fleet.set_policy(policy(&config));
        self.config = config;
        self.apply(ctx);
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.registry.do_send(Unsubscribe(self.id));
    }
}
