//! Actor: owns the state of the fleet and the subscribers; answers picks; sends updates.
//!
//! One for the whole server, created at start; it never ends. It alone decides availability: it gets every report and
//! every pick, so that a pick counts at once. It starts a monitor for each simulation server, and another one if a
//! monitor has panicked.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use rustls::ClientConfig;

use super::changes::Changes;
use super::fleet_status::{FleetStatus, ServerStatus};
use super::pick::{NoServer, Pick};
use super::probe_error::ProbeError;
use super::quota;
use super::server_monitor::{ProbeResult, ProbeSettings, ServerMonitor, Stop};
use super::server_record::{ServerRecord, is_refused};
use super::subscribers::{Subscribers, Update};
use crate::session::config::SessionConfig;
use crate::session::mail::Mailer;
use crate::session::placement::Fleet;
use crate::shared::domain::Load;
use crate::shared::domain::ProjectUrl;
use crate::shared::domain::PublicAddress;
use crate::shared::domain::ServerReport;
use crate::shared::http::{AddressQuota, tls};

/// Asks for an update now, and for another one whenever availability changes.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Subscribe(pub Recipient<Update>);

/// Asks for everything that is known of the fleet.
#[derive(Message)]
#[rtype(result = "Arc<FleetStatus>")]
pub struct GetStatus;

/// Asks whether some simulation server can take a client.
#[derive(Message)]
#[rtype(result = "bool")]
pub struct IsAvailable;

/// Replaces the configuration; see [`SessionConfig::after`] for what counts at once.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Reconfigure(pub Arc<SessionConfig>);

/// The actor.
pub struct Registry {
    config: Arc<SessionConfig>,
    /// The thread of all monitors, so that requests of clients do not wait for them.
    monitors: Arbiter,
    tls: Option<Arc<ClientConfig>>,
    latencies: prometheus::Histogram,
    fleet: Fleet<PublicAddress>,
    quota: AddressQuota,
    servers: BTreeMap<PublicAddress, Entry>,
    subscribers: Subscribers,
    available: bool,
    changes: Changes,
}

/// One simulation server and its monitor.
struct Entry {
    monitor: Addr<ServerMonitor>,
    record: ServerRecord,
}

/// Time between two checks of what changes without a report: placements that expire, monitors that have panicked.
const TICK: Duration = Duration::from_millis(250);

impl Registry {
    /// A registry whose monitors are started with it.
    #[must_use]
    pub fn new(config: Arc<SessionConfig>, mailer: Option<Addr<Mailer>>, latencies: prometheus::Histogram) -> Self {
        Self {
            fleet: Fleet::new(config.policy()),
            quota: quota::placements(),
            monitors: Arbiter::new(),
            tls: tls::client_config(),
            config,
            latencies,
            servers: BTreeMap::new(),
            subscribers: Subscribers::default(),
            available: false,
            changes: Changes::new(mailer),
        }
    }

    /// Starts monitors for new servers and ends those of servers that are no longer listed.
    fn apply(&mut self, ctx: &mut Context<Self>) {
        let config = Arc::clone(&self.config);
        let listed: BTreeSet<&PublicAddress> = config.simulation_servers.iter().collect();
        let drained: BTreeSet<&PublicAddress> = config.drained_servers.iter().collect();
        let gone: Vec<PublicAddress> = self.servers.keys().filter(|known| !listed.contains(known)).cloned().collect();
        for address in gone {
            log::info!("{address}: no longer watched");
            self.fleet.remove(&address);
            if let Some(entry) = self.servers.remove(&address) {
                entry.monitor.do_send(Stop);
            }
        }
        for address in listed {
            let drained = drained.contains(address);
            if let Some(entry) = self.servers.get_mut(address) {
                entry.record.drained = drained;
                continue;
            }
            let monitor = self.start_monitor(address, ctx);
            self.fleet.add(address.clone());
            self.servers.insert(address.clone(), Entry { monitor, record: ServerRecord::new(drained) });
        }
    }

    /// Evaluates the last reports once more, after thresholds or drained servers have changed.
    fn reevaluate(&mut self) {
        let current = self.servers.iter().filter_map(|(address, entry)| {
            let record = &entry.record;
            Some((address.clone(), Ok(record.current()?.clone()), record.answered?))
        });
        for (address, answer, at) in current.collect::<Vec<_>>() {
            self.record(&address, answer, at);
        }
    }

    fn probe_settings(&self) -> ProbeSettings {
        ProbeSettings { interval: self.config.load_refresh, timeout: self.config.timing.answer, ssl: self.config.ssl }
    }

    fn start_monitor(&self, address: &PublicAddress, ctx: &mut Context<Self>) -> Addr<ServerMonitor> {
        let results = ctx.address().recipient();
        let (address, settings, tls) = (address.clone(), self.probe_settings(), self.tls.clone());
        ServerMonitor::start_in_arbiter(&self.monitors.handle(), move |_| {
            ServerMonitor::new(address, settings, tls, results)
        })
    }

    fn tick(&mut self, ctx: &mut Context<Self>) {
        let panicked = self.servers.iter().filter(|(_, entry)| !entry.monitor.connected());
        for address in panicked.map(|(address, _)| address.clone()).collect::<Vec<_>>() {
            log::error!("{address}: its monitor is gone, a new one is started");
            let monitor = self.start_monitor(&address, ctx);
            if let Some(entry) = self.servers.get_mut(&address) {
                entry.monitor = monitor;
            }
        }
        self.changes.restart_mailer_if_gone(&self.config);
        self.publish();
        self.subscribers.retry(Update::Availability(self.available));
    }

    /// Sends an update to the subscribers if availability has changed.
    fn publish(&mut self) {
        let available = self.fleet.available(Instant::now());
        if available == self.available {
            return;
        }
        self.available = available;
        log::info!("{} simulation server is available", if available { "a" } else { "no" });
        self.subscribers.send(Update::Availability(self.available));
    }

    /// Records what a probe of a server brought at this time.
    fn record(&mut self, server: &PublicAddress, answer: Result<ServerReport, ProbeError>, at: Instant) {
        let Some(Entry { record, .. }) = self.servers.get_mut(server) else {
            return;
        };
        let change = match answer {
            Ok(report) => record.succeeded(report, at, self.fleet.limit(server).unwrap_or(self.config.load_threshold)),
            Err(error) => record.failed(error),
        };
        match record.for_placement() {
            Some(report) => self.fleet.report(server, at, report),
            None => self.fleet.lose(server),
        }
        if let Some(change) = change {
            self.changes.add(server, record, change);
        }
    }

    /// Chooses a server for a client of this address.
    fn pick(&mut self, world: Option<&ProjectUrl>, from: Option<IpAddr>) -> Result<PublicAddress, NoServer> {
        let Self { fleet, servers, .. } = self;
        let accepts = |address: &PublicAddress, world| servers.get(address)?.record.accepts(world);
        let eligible = |address: &PublicAddress| world.is_none_or(|world| accepts(address, world) == Some(true));
        let now = Instant::now();
        let picked =
            if self.quota.take(from) { fleet.place(now, eligible) } else { fleet.place_without_room(now, eligible) };
        picked.ok_or_else(|| match world {
            Some(world) if is_refused(servers.values().map(|entry| &entry.record), world) => {
                NoServer::NotAccepted(world.repository())
            }
            _ => NoServer::Unavailable,
        })
    }

    fn status_of(&self, address: &PublicAddress) -> Option<ServerStatus> {
        let status = self.servers.get(address)?.record.status(address);
        Some(ServerStatus {
            effective_load: self.fleet.effective_load(address),
            in_flight: self.fleet.in_flight(address),
            client_cost: self.fleet.client_cost(address),
            ..status
        })
    }
}

impl Actor for Registry {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // The requests and reports of a whole fleet may come in the same moment.
        ctx.set_mailbox_capacity(4096);
        self.apply(ctx);
        ctx.run_interval(TICK, Self::tick);
    }
}

impl Handler<ProbeResult> for Registry {
    type Result = ();

    fn handle(&mut self, ProbeResult { server, latency, answer }: ProbeResult, _: &mut Self::Context) {
        self.latencies.observe(latency.as_secs_f64());
        if let Some(entry) = self.servers.get_mut(&server) {
            entry.record.latency = Some(latency);
        }
        self.record(&server, answer, Instant::now());
        self.publish();
    }
}

impl Handler<Pick> for Registry {
    type Result = Result<PublicAddress, NoServer>;

    fn handle(&mut self, Pick { world, from }: Pick, _: &mut Self::Context) -> Self::Result {
        let answer = self.pick(world.as_ref(), from);
        self.publish();
        answer
    }
}

impl Handler<Subscribe> for Registry {
    type Result = ();

    fn handle(&mut self, Subscribe(recipient): Subscribe, _: &mut Self::Context) {
        self.subscribers.add(recipient, Some(Update::Availability(self.available)));
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
        let servers = self.config.simulation_servers.iter().filter_map(|address| self.status_of(address));
        MessageResult(Arc::new(FleetStatus {
            available: self.available,
            mean_load: Load::mean(self.servers.values().filter_map(|entry| entry.record.load())).map(Load::percent),
            servers: servers.collect(),
            changes: self.changes.recent().clone(),
        }))
    }
}

impl Handler<Reconfigure> for Registry {
    type Result = ();

    fn handle(&mut self, Reconfigure(config): Reconfigure, ctx: &mut Self::Context) {
        let before = self.probe_settings();
        let config = Arc::new(self.config.reload(&config));
        self.fleet.set_policy(config.policy());
        self.config = config;
        self.apply(ctx);
        let settings = self.probe_settings();
        if settings != before {
            for entry in self.servers.values() {
                entry.monitor.do_send(settings);
            }
        }
        self.reevaluate();
        self.publish();
    }
}
