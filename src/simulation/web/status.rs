//! The simulation server for other programs: `/status` and `/metrics`.

use serde::Serialize;

use super::webots_viewer;
use crate::shared::domain::ServerReport;
use crate::shared::http::Gauge;
use crate::simulation::isolation::{IsolationLevel, Network};
use crate::simulation::machine::sensors::{Gpu, Host, Machine};
use crate::simulation::snapshot::{Simulation, Snapshot};
use crate::simulation::state::AppState;

/// The page `/status`.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct StatusResponse {
    /// The part that session servers parse.
    #[serde(flatten)]
    pub report: ServerReport,
    /// The isolation level of simulations.
    pub isolation: IsolationLevel,
    /// Which network their programs have, where that is not Docker's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
    /// Time since the start, in seconds.
    pub uptime: u64,
    /// Name, system and hardware of the machine.
    pub host: Host,
    /// The newest reading of the machine.
    pub machine: Machine,
    /// The newest readings of its GPUs.
    pub gpus: Vec<Gpu>,
    /// The problem with the GPUs, if some have answered before and don't any more.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpu_problem: Option<String>,
    /// Path of Webots' own viewer on this server, if it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub viewer: Option<&'static str>,
    /// Each simulation.
    pub simulations: Vec<Simulation>,
}

impl StatusResponse {
    /// The state of the server at this moment.
    pub fn new(server: &AppState, snapshot: Snapshot) -> Self {
        let readings = server.readings.borrow().clone();
        let rules = &server.rules;
        let report = ServerReport {
            load: server.load(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            instances: Some(snapshot.instances),
            allowed_repositories: rules.allowed.clone(),
            blocked_repositories: rules.blocked.clone(),
            share_idle_time: rules.share_idle_time,
            docker: Some(rules.docker),
            draining: server.is_draining(),
            failed_starts: server.failed_starts.count(),
            problem: server.problem(),
        };
        Self {
            report,
            isolation: server.launcher.level(),
            network: server.launcher.network(),
            uptime: server.started.elapsed().as_secs(),
            host: readings.host.clone(),
            machine: readings.machine,
            gpus: readings.gpus.clone(),
            gpu_problem: readings.gpu_problem.clone(),
            viewer: webots_viewer::folder(&server.config).map(|_| webots_viewer::PATH),
            simulations: snapshot.simulations,
        }
    }
}

/// The gauges of `/metrics`.
pub fn gauges<'text>(server: &AppState, snapshot: &Snapshot) -> Vec<Gauge<'text>> {
    let readings = server.readings.borrow();
    let instances = snapshot.instances;
    let machine = readings.machine;
    let by_state = [
        ("queued", instances.queued),
        ("starting", instances.starting),
        ("idle", instances.idle),
        ("running", instances.running),
    ];
    let gpu = |value: fn(&Gpu) -> f64| {
        let labels = |gpu: &Gpu| vec![gpu.index.to_string(), gpu.name.clone()];
        readings.gpus.iter().map(|gpu| (labels(gpu), value(gpu))).collect()
    };
    let ready = f64::from(u8::from(server.problem().is_none()));
    let failed_starts = f64::from(server.failed_starts.count());
    let away = snapshot.simulations.iter().filter(|one| one.away_until.is_some()).count();
    let away = u32::try_from(away).unwrap_or(u32::MAX);
    let draining = f64::from(u8::from(server.is_draining()));
    vec![
        Gauge::plain("webots_simulation_load_percent", "Load as /load tells it", server.load().percent()),
        Gauge::plain("webots_simulation_ready", "0 while no simulation can be started", ready),
        Gauge::plain(
            "webots_simulation_failed_starts",
            "Starts in a row that failed for a reason of this server's own",
            failed_starts,
        ),
        Gauge::plain("webots_simulation_draining", "1 while no new clients are taken", draining),
        Gauge::plain("webots_simulation_away", "Simulations that wait for their clients", f64::from(away)),
        Gauge::plain("webots_simulation_places", "Simulations that fit", f64::from(instances.places)),
        Gauge {
            name: "webots_simulation_instances",
            help: "Simulations by state",
            labels: &["state"],
            values: by_state.iter().map(|(state, count)| (vec![(*state).to_owned()], f64::from(*count))).collect(),
        },
        Gauge::plain("webots_machine_cpu_percent", "CPU in use", machine.cpu),
        Gauge::plain("webots_machine_memory_percent", "Memory in use", machine.memory),
        Gauge::plain("webots_machine_swap_percent", "Swap in use", machine.swap),
        Gauge::plain("webots_machine_disk_percent", "Disk in use where the cache is", machine.disk),
        Gauge::plain(
            "webots_machine_gpu_lost",
            "1 while GPUs have answered and some or all don't any more",
            f64::from(u8::from(readings.gpu_problem.is_some())),
        ),
        Gauge {
            name: "webots_machine_gpu_compute_percent",
            help: "GPU: time in which a kernel ran",
            labels: &["gpu", "name"],
            values: gpu(|gpu| gpu.compute),
        },
        Gauge {
            name: "webots_machine_gpu_memory_percent",
            help: "GPU: memory in use",
            labels: &["gpu", "name"],
            values: gpu(|gpu| gpu.memory),
        },
    ]
}
