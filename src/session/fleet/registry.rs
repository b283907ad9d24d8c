//! Actor: owns the state of the fleet; answers picks; publishes whether a server can take a client.
//!
//! One for the whole server, created at start; it never ends. It alone decides availability: it receives every report
//! and every pick, so that a pick counts at once. It looks names up, and starts a monitor for each simulation server.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use prometheus::Histogram;
use tokio::sync::watch;

use super::line_keeper::{LineKeeper, StopWaiting, Wait};
use super::name_table::look_up_all;
use super::ready_shares::ReadyShares;
use super::server_monitor::{GetRecords, Parent, ProbeResult};
use super::server_record::{Answer, FleetStatus, Intake, ServerRecord, ServerState, ServerStatus};
use super::server_table::{ServerTable, admission};
use super::slot_link::LinkEvent;
use super::state_history::StateHistory;
use crate::session::class::{ClassEntry, Roster};
use crate::session::config::SessionConfig;
use crate::session::line::Place;
use crate::shared::domain::{Admission, Failure, Load, ProjectUrl, PublicAddress, ReadyEntry, Reason, ServerReport};
use crate::shared::http::AddressQuota;

/// Requests the least loaded simulation server that accepts this world.
#[derive(Message, Debug)]
#[rtype(result = "Result<PublicAddress, Failure>")]
pub struct Pick {
    /// The world, if the client named one.
    pub world: Option<ProjectUrl>,
    /// The client's address, if it is known.
    pub from: Option<IpAddr>,
}

/// Requests the status of the fleet.
#[derive(Message)]
#[rtype(result = "Arc<FleetStatus>")]
pub struct GetStatus;

/// Requests the clients that wait in the line.
#[derive(Message)]
#[rtype(result = "Vec<ClassEntry>")]
pub struct GetWaiting;

/// Requests the monitors of all servers, for requests of records.
#[derive(Message)]
#[rtype(result = "Vec<(PublicAddress, Recipient<GetRecords>)>")]
pub struct GetMonitors;

/// Replaces the configuration: the servers, the placement policy, and how servers are probed. What was learned stays.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Reconfigure(pub Arc<SessionConfig>);

/// The actor.
pub struct Registry {
    config: Arc<SessionConfig>,
    /// Limits the placements of an address that reserve room. A placement reserves room until its client arrives or is
    /// given up, so a client that requests servers again and again could lock out all others. Placements beyond the limit
    /// take room only once their clients have arrived.
    quota: AddressQuota,
    servers: ServerTable,
    line: LineKeeper,
    ready: ReadyShares,
    /// Whether a simulation server can take a client; all web clients follow it.
    available: watch::Sender<bool>,
    changes: StateHistory,
    /// What has to be looked at once the messages that have come are handled.
    pending: Pending,
}

/// Whether messages have changed something.
#[derive(Default)]
struct Pending {
    /// A [`Settle`] is on its way.
    is_scheduled: bool,
    /// The line has changed, or a server's answer to it.
    line: bool,
}

/// Works out what follows from all messages that were handled before: many may come at the same moment.
#[derive(Message)]
#[rtype(result = "()")]
struct Settle;

/// Pause between two lookups of the names.
const LOOKUP_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between checks of what changes without a report: placements that expire, and monitors that have panicked.
const TICK: Duration = Duration::from_millis(250);

impl Registry {
    /// Starts the registry and its monitors. It publishes in `available` whether a server can take a client, and observes
    /// in `waited` how long clients have waited in the line. Simulation servers tell `roster` which simulations they have. `requested`
    /// are the worlds that `POST /ready` asks for.
    ///
    /// # Errors
    /// When the system starts no thread for the monitors.
    pub fn start(
        config: Arc<SessionConfig>,
        available: watch::Sender<bool>,
        waited: Histogram,
        roster: Arc<Roster>,
        requested: watch::Receiver<Vec<ReadyEntry>>,
    ) -> std::io::Result<Addr<Self>> {
        let thread = Arbiter::try_new()?.handle();
        Ok(Self::create(|ctx| {
            let parent = Parent {
                probes: ctx.address().recipient(),
                links: ctx.address().recipient(),
                roster,
            };
            let servers = ServerTable::new(&config, thread, parent);
            Self {
                // A large class behind one address may reserve room at once.
                quota: AddressQuota::new(200, 12),
                changes: StateHistory::new(&config),
                pending: Pending::default(),
                line: LineKeeper::new(waited, config.fleet_key.is_some()),
                ready: ReadyShares::new(requested),
                config,
                servers,
                available,
            }
        }))
    }

    /// Has the consequences of a message worked out.
    fn settle(&mut self, ctx: &mut Context<Self>) {
        if !self.pending.is_scheduled {
            self.pending.is_scheduled = true;
            // actix handles it after the messages that have come.
            ctx.notify(Settle);
        }
    }

    /// Publishes a change of availability, to those who are not in the line.
    fn publish(&mut self) {
        let ServerTable { records, fleet, .. } = &mut self.servers;
        let is_left = |server: &PublicAddress, load: f64| !self.line.claims(records, server, load);
        let available = fleet.available(Instant::now(), is_left);
        if *self.available.borrow() != available {
            log::info!("{} simulation server is available", if available { "a" } else { "no" });
            self.available.send_replace(available);
        }
    }

    /// Records the result of a probe.
    fn record(&mut self, server: &PublicAddress, latency: Duration, answer: Result<ServerReport, Failure>) {
        let ServerTable {
            records, fleet, ready, ..
        } = &mut self.servers;
        let Some(record) = records.get_mut(server) else { return };
        let before = record.state.last_answer().map(|answer| Arc::clone(&answer.report));
        let change = match answer {
            Ok(report) => {
                let now = Instant::now();
                let report = Arc::new(report);
                let limit = fleet.limit(server).unwrap_or(self.config.load_threshold);
                let answer = Answer {
                    report: Arc::clone(&report),
                    at: now,
                    latency,
                };
                let change = record.answered(answer, limit);
                let is_draining = matches!(
                    record.state,
                    ServerState::Answering {
                        intake: Intake::Draining,
                        ..
                    }
                );
                let was_ejected = fleet.is_ejected(server);
                fleet.report(server, now, &report, !is_draining);
                ready.report(server, now, &report);
                if fleet.is_ejected(server) && !was_ejected {
                    log::warn!("{server}: {}", ejected(report.failed_starts));
                }
                change
            }
            Err(failure) => {
                fleet.lose(server);
                ready.lose(server);
                record.failed(failure, latency)
            }
        };
        if let Some(change) = change {
            self.changes.add(change);
        }
        self.line.reported(&self.servers, server, before.as_deref());
    }

    /// Chooses a server for a client of this address.
    fn pick(&mut self, world: Option<&ProjectUrl>, from: Option<IpAddr>) -> Result<PublicAddress, Failure> {
        let ServerTable {
            records, fleet, ready, ..
        } = &mut self.servers;
        let line = &self.line;
        let terms = |address: &PublicAddress, load: f64| {
            if line.claims(records, address, load) {
                return None;
            }
            match world {
                Some(world) => admission(records)(address, world, load),
                None => Some(Admission::Dedicated),
            }
        };
        let now = Instant::now();
        let takes_room = self.quota.take(from);
        let picked = match world.filter(|world| ready.has(world)) {
            Some(world) => fleet.pick_ready_first(now, takes_room, |address| ready.left(address, world) > 0, terms),
            None => fleet.pick_admitted(now, takes_room, terms),
        };
        if let Some((server, world)) = picked.as_ref().zip(world) {
            ready.place(server, world, now);
        }
        picked.ok_or_else(|| self.servers.refusal(world))
    }

    fn status_of(&self, record: &ServerRecord) -> ServerStatus {
        let fleet = &self.servers.fleet;
        let address = &record.address;
        let failed_starts = record.state.report().map_or(0, |report| report.failed_starts);
        let failure = record.state.failure().cloned();
        ServerStatus {
            failure: failure.or_else(|| fleet.is_ejected(address).then(|| ejected(failed_starts))),
            effective_load: fleet.effective_load(address),
            in_flight: fleet.in_flight(address),
            client_cost: fleet.client_cost(address),
            record: record.clone(),
        }
    }

    /// Looks up all names periodically.
    fn look_up_names(&mut self, ctx: &mut Context<Self>) {
        look_up_all(self.servers.names.names())
            .into_actor(self)
            .map(|answers, registry, ctx| {
                if registry.servers.names.record(answers) {
                    registry.servers.follow_names(&registry.config);
                    registry.line.set_servers(&registry.servers);
                    registry.settle(ctx);
                }
                ctx.run_later(LOOKUP_INTERVAL, Self::look_up_names);
            })
            .spawn(ctx);
    }
}

/// Why a server is ejected.
fn ejected(failed: u32) -> Failure {
    Failure::new(
        Reason::StartsFail,
        format!("its last {failed} starts failed for a reason of its own; others are preferred for a while"),
    )
}

impl Actor for Registry {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // The requests and reports of a whole fleet may arrive at the same moment.
        ctx.set_mailbox_capacity(4096);
        self.servers.apply(&self.config);
        self.line.set_servers(&self.servers);
        ctx.run_interval(TICK, |registry, _| {
            registry.servers.restart_monitors(&registry.config);
            registry.line.tick(&mut registry.servers);
            registry.ready.tick(&registry.servers, &registry.config);
            registry.publish();
        });
        self.look_up_names(ctx);
    }
}

impl Handler<ProbeResult> for Registry {
    type Result = ();

    fn handle(
        &mut self,
        ProbeResult {
            server,
            latency,
            answer,
        }: ProbeResult,
        ctx: &mut Self::Context,
    ) {
        self.record(&server, latency, answer);
        self.settle(ctx);
    }
}

impl Handler<Pick> for Registry {
    type Result = Result<PublicAddress, Failure>;

    fn handle(&mut self, Pick { world, from }: Pick, ctx: &mut Self::Context) -> Self::Result {
        let answer = self.pick(world.as_ref(), from);
        self.settle(ctx);
        answer
    }
}

impl Handler<Wait> for Registry {
    type Result = Result<Option<Place>, Failure>;

    fn handle(&mut self, wait: Wait, ctx: &mut Self::Context) -> Self::Result {
        self.pending.line = true;
        self.settle(ctx);
        self.line.enter(&self.servers, wait)
    }
}

impl Handler<StopWaiting> for Registry {
    type Result = ();

    fn handle(&mut self, stop: StopWaiting, ctx: &mut Self::Context) {
        self.line.leave(stop);
        self.pending.line = true;
        self.settle(ctx);
    }
}

impl Handler<LinkEvent> for Registry {
    type Result = ();

    fn handle(&mut self, event: LinkEvent, ctx: &mut Self::Context) {
        self.ready.link(&event);
        self.line.link(&mut self.servers, event);
        self.pending.line = true;
        self.settle(ctx);
    }
}

impl Handler<Settle> for Registry {
    type Result = ();

    fn handle(&mut self, _: Settle, _: &mut Self::Context) {
        if std::mem::take(&mut self.pending).line {
            self.line.serve(&mut self.servers);
        }
        self.publish();
    }
}

impl Handler<GetStatus> for Registry {
    type Result = MessageResult<GetStatus>;

    fn handle(&mut self, _: GetStatus, _: &mut Self::Context) -> Self::Result {
        let loads = self
            .servers
            .records
            .values()
            .filter_map(|record| Some(record.state.report()?.load));
        MessageResult(Arc::new(FleetStatus {
            available: *self.available.borrow(),
            mean_load: Load::mean(loads).map(Load::percent),
            servers: self.servers.in_order().map(|record| self.status_of(record)).collect(),
            names: self.servers.names.status(),
            changes: self.changes.recent.clone(),
            line: self.line.status(),
            ready: self.ready.wanted(&self.config),
            requested: self.ready.requested(),
        }))
    }
}

impl Handler<GetMonitors> for Registry {
    type Result = MessageResult<GetMonitors>;

    fn handle(&mut self, _: GetMonitors, _: &mut Self::Context) -> Self::Result {
        MessageResult(self.servers.monitors())
    }
}

impl Handler<GetWaiting> for Registry {
    type Result = MessageResult<GetWaiting>;

    fn handle(&mut self, _: GetWaiting, _: &mut Self::Context) -> Self::Result {
        MessageResult(self.line.waiting())
    }
}

impl Handler<Reconfigure> for Registry {
    type Result = ();

    fn handle(&mut self, Reconfigure(config): Reconfigure, ctx: &mut Self::Context) {
        self.servers.apply(&config);
        self.line.set_servers(&self.servers);
        self.config = config;
        self.settle(ctx);
    }
}
