//! The state that the routes, the pages and the web clients of a simulation server share. `app` creates it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use actix::{Addr, ArbiterHandle};
use jiff::Timestamp;
use tokio::sync::watch;

use super::attachment::ResumableSessions;
use super::config::SimulationConfig;
use super::ends::Ends;
use super::handover::Predecessors;
use super::handover::control::ForwardedStop;
use super::readiness::FailedStarts;
use super::slots::{SlotPool, SpareKind, SpareStatus};
use super::spare_wishes::SpareWishes;
use crate::shared::domain::{
    AdmissionRules, Failure, FleetKey, Load, Pass, ProjectUrl, ReadyStatus, Reason, ReservationId, ServerRun,
};
use crate::shared::http::{AddressQuota, AdminAuth, ConnectionLimiter, LiveUpdates, Metrics, SharedPage};
use crate::shared::run::Phase;
use crate::shared::text::excerpt;
use crate::simulation::checkout::CheckoutService;
use crate::simulation::container::ContainerService;
use crate::simulation::isolation::{DiskMonitor, Launcher};
use crate::simulation::machine::{self, LoadMonitor, Readings, Spread, UsageMonitor, Usages};
use crate::simulation::process::RunDir;
use crate::simulation::snapshot::Snapshot;
use crate::simulation::{container, protocol};

/// Longest reason of a stop, in characters.
const MAX_REASON_LENGTH: usize = 300;

/// Threads that start Webots: `spawn` blocks until `execve`, which takes long on a busy machine. They live as long as
/// the server, because bubblewrap exits with the thread that has started it.
pub const WEBOTS_THREADS: usize = 4;

/// The shared state.
pub struct AppState {
    /// The effective configuration.
    pub config: Arc<SimulationConfig>,
    /// The key of the fleet, if there is one.
    pub fleet_key: Option<FleetKey>,
    /// This run of the server, for which passes are valid.
    pub server_run: ServerRun,
    /// The secret that signs administrators' sign-ins in a fleet without a key.
    pub sign_in: String,
    /// Which worlds may run.
    pub rules: AdmissionRules,
    /// The processes of this server before this one.
    pub predecessors: Arc<Predecessors>,
    /// The slots of all simulations.
    pub slots: Arc<SlotPool>,
    /// What simulations are asked for to be kept ready.
    pub spare_wishes: SpareWishes,
    /// The sessions that their clients can resume.
    pub sessions: Arc<ResumableSessions>,
    /// Measures the load of the machine.
    pub load_monitor: Addr<LoadMonitor>,
    /// The newest readings of the machine.
    pub readings: watch::Receiver<Arc<Readings>>,
    /// Chooses the GPU of each simulation, if they are spread over several.
    pub spread: Option<Arc<Spread>>,
    /// Launches simulations at a level of isolation.
    pub launcher: Arc<Launcher>,
    /// Monitors the limits of simulations.
    pub disk_monitor: DiskMonitor,
    /// Creates the containers of simulations; `None` if they don't run in containers.
    pub containers: Option<Arc<ContainerService>>,
    /// Checks worlds out.
    pub checkouts: Arc<CheckoutService>,
    /// The directory of this run, with the directories of simulations in it.
    pub run: Arc<RunDir>,
    /// Whether the server accepts clients.
    pub phase: watch::Sender<Phase>,
    /// Why the server can't start simulations; `None` if it can.
    pub problem: watch::Receiver<Option<String>>,
    /// Counts consecutive failed starts of which this server is the cause.
    pub failed_starts: Arc<FailedStarts>,
    /// Records the ends of simulations.
    pub ends: Ends,
    /// The threads on which the actors of Webots run.
    pub webots_threads: [ArbiterHandle; WEBOTS_THREADS],
    /// Tells administrators from others.
    pub admin_auth: Arc<AdminAuth>,
    /// Limits and counts connections.
    pub connections: ConnectionLimiter,
    /// Rate limit of requests for simulations per address.
    pub start_quota: AddressQuota,
    /// Counters for `/metrics`.
    pub metrics: Metrics,
    /// Counts requests for simulations, by outcome.
    pub starts: prometheus::IntCounterVec,
    /// The monitor page of visitors without the password.
    pub monitor: SharedPage,
    /// The open monitor pages.
    pub live: LiveUpdates,
    /// The open monitor pages of administrators, which show more.
    pub administrators: LiveUpdates,
    /// CPU and memory of each simulation.
    pub usage: UsageMonitor,
    /// The page of a session server of the fleet that lists the simulations of all servers.
    pub class_page: watch::Sender<Option<url::Url>>,
    /// When the server was started.
    pub started: Instant,
}

impl AppState {
    /// Returns the thread for the Webots with this port.
    pub fn webots_thread(&self, port: u16) -> &ArbiterHandle {
        let [first, second, third, fourth] = &self.webots_threads;
        match port % 4 {
            0 => first,
            1 => second,
            2 => third,
            _ => fourth,
        }
    }

    /// Returns the load to report: 100 % while the server is draining or can't start simulations.
    pub fn load(&self) -> Load {
        if self.takes_nobody() {
            Load::FULL
        } else {
            self.readings.borrow().load.unwrap_or(Load::ZERO)
        }
    }

    /// Returns the load for programs that know nothing else of this server: as [`Self::load`], but at least
    /// [`Load::NO_SLOT`] while no slot is free.
    pub fn load_with_slots(&self) -> Load {
        let instances = self.slots.instances();
        if instances.present() < instances.slots || self.load() > Load::NO_SLOT {
            self.load()
        } else {
            Load::NO_SLOT
        }
    }

    /// Whether the server accepts no client, regardless of its world.
    pub fn takes_nobody(&self) -> bool {
        self.is_draining() || self.problem.borrow().is_some()
    }

    /// Accepts no new clients from now on; the server ends when the last one has left.
    pub fn drain(&self) {
        if self.leave_open(Phase::Draining) {
            log::info!("draining: no new clients, the server ends when the last has gone");
        }
    }

    /// Enters this phase if the server is open. Returns whether it was.
    pub fn leave_open(&self, next: Phase) -> bool {
        self.phase.send_if_modified(|phase| {
            let is_open = *phase == Phase::Open;
            if is_open {
                *phase = next;
            }
            is_open
        })
    }

    /// Stops the simulations with these ids, for a reason, which may be empty; `by` is who stops them, for the log. Returns
    /// the ids of those that are there.
    pub async fn stop(&self, ids: &[String], reason: &str, by: &str) -> Vec<String> {
        let order = ForwardedStop {
            ids: ids.to_vec(),
            reason: reason.to_owned(),
            by: by.to_owned(),
        };
        let mut stopped = self.stop_here(ids, reason, by);
        stopped.extend(self.predecessors.stop(order).await);
        stopped
    }

    /// As [`Self::stop`], those of this process.
    pub fn stop_here(&self, ids: &[String], reason: &str, by: &str) -> Vec<String> {
        let reason = excerpt(reason.trim(), MAX_REASON_LENGTH);
        let stopped = self.slots.stop(
            ids,
            &protocol::stopped_by_administrator(&self.config.stop_text, &reason),
        );
        for id in &stopped {
            log::info!(
                "{id}: {by} stops it, reason: {}",
                if reason.is_empty() { "none" } else { &reason }
            );
        }
        stopped
    }

    /// The URL of the page that lists the simulations of all servers, if a session server of the fleet has told one.
    pub fn class_page(&self) -> Option<String> {
        self.class_page.borrow().as_ref().map(url::Url::to_string)
    }

    /// What each simulation uses, as it was measured at most two seconds ago.
    pub async fn usages(&self, snapshot: &Snapshot) -> Usages {
        if snapshot.simulations.is_empty() {
            return Usages::new();
        }
        let usage = self.usage.clone();
        let simulations = snapshot.simulations.iter();
        let read = if let Some(containers) = &self.containers {
            // The process is `docker`, which waits for the containers.
            let roots: BTreeMap<u16, i32> = simulations
                .filter_map(|simulation| Some((simulation.port?, simulation.pid?)))
                .collect();
            let owner = containers.run.clone();
            actix_rt::task::spawn_blocking(move || usage.read(|| container::measure(&owner, &roots)))
        } else {
            let roots: Vec<i32> = simulations.filter_map(|simulation| simulation.pid).collect();
            actix_rt::task::spawn_blocking(move || usage.read(|| machine::usages(&roots)))
        };
        read.await.unwrap_or_default()
    }

    /// Whether new clients are refused.
    pub fn is_draining(&self) -> bool {
        *self.phase.borrow() != Phase::Open
    }

    /// Checks whether a world may run here now: its URL, the rules, and that the server accepts clients. Returns the
    /// slot that is reserved for a client with this pass.
    ///
    /// # Errors
    /// Why it may not.
    pub fn admit(&self, url: &str, pass: Option<&str>) -> Result<(ProjectUrl, Option<ReservationId>), Failure> {
        let world = ProjectUrl::parse(url).map_err(|wrong| Failure::new(Reason::InvalidWorld, wrong.to_string()))?;
        let reservation = self.reservation(&world, pass)?;
        let load = if reservation.is_some() {
            // A slot that was reserved before is given, although the server drains or its load has risen.
            Load::ZERO
        } else if self.is_draining() {
            let message = "This simulation server is about to end, and takes no new clients";
            return Err(Failure::new(Reason::Draining, message));
        } else {
            self.load()
        };
        if let Some(problem) = self.problem() {
            return Err(Failure::new(Reason::NotReady, problem));
        }
        self.rules.admit(&world, load)?;
        Ok((world, reservation))
    }

    /// What a pass for this world is for. A server without the fleet's key reserves no slots, and ignores passes.
    fn reservation(&self, world: &ProjectUrl, pass: Option<&str>) -> Result<Option<ReservationId>, Failure> {
        let Some((key, pass)) = self.fleet_key.as_ref().zip(pass) else {
            return Ok(None);
        };
        let pass = Pass::read(pass, key, world).filter(|pass| pass.server == self.server_run);
        let pass = pass.ok_or_else(|| {
            let message = "This pass is not valid for this world on this simulation server";
            Failure::new(Reason::InvalidPass, message)
        })?;
        Ok(Some(pass.reservation))
    }

    /// What is kept ready for clients, by world.
    pub fn ready(&self) -> Vec<ReadyStatus> {
        let mut problems = self.spare_wishes.problems();
        let mut spares = self.slots.spares();
        let status = |(kind, wanted): (SpareKind, u32)| {
            let there = spares.remove(&kind).unwrap_or_default();
            let count = |matches: fn(&SpareStatus) -> bool| {
                u32::try_from(there.iter().filter(|one| matches(one)).count()).unwrap_or(u32::MAX)
            };
            ReadyStatus {
                wanted,
                ready: count(|one| one.is_ready && !one.is_outdated && !one.is_reserved),
                starting: count(|one| !one.is_ready),
                problem: problems.remove(&kind),
                mode: kind.view,
                world: kind.world,
            }
        };
        let wanted = self.spare_wishes.wanted(Timestamp::now(), Instant::now());
        wanted.into_iter().map(status).collect()
    }

    /// Returns why this server can't start simulations; `None` if it can.
    pub fn problem(&self) -> Option<String> {
        self.problem.borrow().clone()
    }
}
