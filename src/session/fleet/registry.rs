//! Actor: owns the fleet's state and the subscribers; answers picks; pushes changes.
//!
//! One for the whole server, created at start; it never ends. It alone decides availability: it hears of every report
//! and of every pick, so that a pick counts at once. It makes a monitor for each simulation server, and a new one if
//! a monitor has panicked.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use rustls::ClientConfig;

use super::changes::Changes;
use super::fleet_status::{FleetStatus, ServerStatus};
use super::pick::{NoServer, Pick};
use super::probe_error::Unreachable;
use super::server_monitor::{Forget, Reported, ServerMonitor, Watch};
use super::server_record::Watched;
use super::subscribers::{News, Subscribers};
use crate::session::config::SessionConfig;
use crate::session::mail::Mailer;
use crate::session::placement::Fleet;
use crate::shared::domain::Load;
use crate::shared::domain::ProjectUrl;
use crate::shared::domain::PublicAddress;
use crate::shared::domain::ServerReport;
use crate::shared::http::tls;

/// Asks to be told of availability, now and whenever it changes.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Subscribe(pub Recipient<News>);

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

/// The actor.
pub struct Registry {
    config: Arc<SessionConfig>,
    /// The monitors' thread: what they do must not keep the door waiting.
    watchers: Arbiter,
    trust: Option<Arc<ClientConfig>>,
    latencies: prometheus::Histogram,
    fleet: Fleet<PublicAddress>,
    servers: BTreeMap<PublicAddress, Member>,
    subscribers: Subscribers,
    available: bool,
    changes: Changes,
}

/// One simulation server and who watches it.
struct Member {
    monitor: Addr<ServerMonitor>,
    watched: Watched,
}

/// Between two looks at what changes without a report: placements that expire, monitors that are gone.
const LOOK: Duration = Duration::from_millis(250);

impl Registry {
    /// Prepares the registry; its monitors start with it.
    #[must_use]
    pub fn new(config: Arc<SessionConfig>, mailer: Option<Addr<Mailer>>, latencies: prometheus::Histogram) -> Self {
        Self {
            fleet: Fleet::new(config.policy()),
            watchers: Arbiter::new(),
            trust: tls::client_config(),
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
            if let Some(member) = self.servers.remove(&address) {
                member.monitor.do_send(Forget);
            }
        }
        for address in listed {
            let drained = drained.contains(address);
            if let Some(member) = self.servers.get_mut(address) {
                member.watched.drained = drained;
                continue;
            }
            let monitor = self.monitor(address, ctx);
            self.fleet.add(address.clone());
            self.servers.insert(address.clone(), Member { monitor, watched: Watched::new(drained) });
        }
    }

    /// Judges what is known anew: thresholds or drained servers may be others.
    fn judge_again(&mut self) {
        let known = self.servers.iter().filter_map(|(address, member)| {
            let watched = &member.watched;
            Some((address.clone(), Ok(watched.current()?.clone()), watched.answered?))
        });
        for (address, answer, at) in known.collect::<Vec<_>>() {
            self.take_in(&address, answer, at);
        }
    }

    fn watch(&self) -> Watch {
        Watch { refresh: self.config.load_refresh, patience: self.config.timing.answer, ssl: self.config.ssl }
    }

    fn monitor(&self, address: &PublicAddress, ctx: &mut Context<Self>) -> Addr<ServerMonitor> {
        let reports = ctx.address().recipient();
        let (address, watch, trust) = (address.clone(), self.watch(), self.trust.clone());
        ServerMonitor::start_in_arbiter(&self.watchers.handle(), move |_| {
            ServerMonitor::new(address, watch, trust, reports)
        })
    }

    /// What happens without a message.
    fn look(&mut self, ctx: &mut Context<Self>) {
        let lost = self.servers.iter().filter(|(_, member)| !member.monitor.connected());
        for address in lost.map(|(address, _)| address.clone()).collect::<Vec<_>>() {
            log::error!("{address}: its monitor is gone, a new one is started");
            let monitor = self.monitor(&address, ctx);
            if let Some(member) = self.servers.get_mut(&address) {
                member.monitor = monitor;
            }
        }
        self.changes.look_after_mailer(&self.config);
        self.publish();
        self.subscribers.tell_late(News::Availability(self.available));
    }

    /// Tells the subscribers, if availability has changed.
    fn publish(&mut self) {
        let available = self.fleet.available(Instant::now());
        if available == self.available {
            return;
        }
        self.available = available;
        log::info!("{} simulation server is available", if available { "a" } else { "no" });
        self.subscribers.tell(News::Availability(self.available));
    }

    /// Takes in what came of a server at this time.
    fn take_in(&mut self, server: &PublicAddress, answer: Result<ServerReport, Unreachable>, at: Instant) {
        let Some(Member { watched, .. }) = self.servers.get_mut(server) else {
            return;
        };
        let change = match answer {
            Ok(report) => watched.said(report, at, self.fleet.limit(server).unwrap_or(self.config.load_threshold)),
            Err(error) => watched.failed(error),
        };
        match watched.for_placement() {
            Some(report) => self.fleet.report(server, at, report),
            None => self.fleet.lose(server),
        }
        if let Some(change) = change {
            self.changes.tell(server, watched, change);
        }
    }

    /// Which server gets a client.
    fn pick(&mut self, world: Option<&ProjectUrl>, from: Option<IpAddr>) -> Result<PublicAddress, NoServer> {
        let Self { fleet, servers, .. } = self;
        let accepts = |address: &PublicAddress, world: &ProjectUrl| {
            // One that has said nothing yet may accept it.
            let says = |report: &ServerReport| report.accepts(world);
            servers.get(address).is_some_and(|member| member.watched.report.as_ref().is_none_or(says))
        };
        let eligible = |address: &PublicAddress| world.is_none_or(|world| accepts(address, world));
        let picked = fleet.place_from(Instant::now(), from, eligible);
        picked.ok_or_else(|| match world {
            Some(world) if !servers.is_empty() && !servers.keys().any(|address| accepts(address, world)) => {
                NoServer::NotAccepted(world.repository())
            }
            _ => NoServer::Unavailable,
        })
    }

    fn status_of(&self, address: &PublicAddress, now: Instant) -> Option<ServerStatus> {
        let status = self.servers.get(address)?.watched.status(address);
        Some(ServerStatus {
            effective_load: self.fleet.effective_load(address, now),
            in_flight: self.fleet.in_flight(address, now),
            client_cost: self.fleet.learned_cost(address),
            ..status
        })
    }
}

impl Actor for Registry {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // Requests and reports of a whole fleet may come in the same moment; what is more waits outside.
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
        if let Some(member) = self.servers.get_mut(&server) {
            member.watched.latency = Some(latency);
        }
        self.take_in(&server, answer, Instant::now());
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

    fn handle(&mut self, Subscribe(audience): Subscribe, _: &mut Self::Context) {
        self.subscribers.add(audience, Some(News::Availability(self.available)));
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
            mean_load: Load::mean(self.servers.values().filter_map(|member| member.watched.load())),
            servers: servers.collect(),
            changes: self.changes.recent().clone(),
        }))
    }
}

impl Handler<Reconfigure> for Registry {
    type Result = ();

    fn handle(&mut self, Reconfigure(config): Reconfigure, ctx: &mut Self::Context) {
        let before = self.watch();
        let config = Arc::new(config.after(&self.config));
        self.fleet.set_policy(Instant::now(), config.policy());
        self.config = config;
        self.apply(ctx);
        let watch = self.watch();
        if watch != before {
            for member in self.servers.values() {
                member.monitor.do_send(watch);
            }
        }
        self.judge_again();
        self.publish();
    }
}
