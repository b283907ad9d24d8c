//! The Prometheus metrics of `/metrics` that follow from the state of the server. The counter of starts and
//! the histogram of real-time factors are in `app.rs`, the counter of ends in `ends/ends.rs`.

use crate::shared::domain::ReadyStatus;
use crate::shared::http::Gauge;
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::snapshot::Snapshot;
use crate::simulation::state::AppState;

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
    let ready = server.ready();
    let spares = |count: fn(&ReadyStatus) -> u32| f64::from(ready.iter().map(count).fold(0, u32::saturating_add));
    let of_spares = [
        ("wanted", spares(|one| one.wanted)),
        ("ready", spares(|one| one.ready)),
        ("starting", spares(|one| one.starting)),
        ("failing", spares(|one| u32::from(one.problem.is_some()))),
    ];
    let flag = |is_set: bool| f64::from(u8::from(is_set));
    let failed = "Starts in a row that failed for a reason of this server's own";
    let lost = "1 while GPUs have answered and some or all don't any more";
    vec![
        Gauge::plain(
            "webots_simulation_load_percent",
            "Load as /load tells it",
            server.load().percent(),
        ),
        Gauge::plain(
            "webots_simulation_ready",
            "0 while no simulation can be started",
            flag(server.problem().is_none()),
        ),
        Gauge::plain(
            "webots_simulation_failed_starts",
            failed,
            f64::from(server.failed_starts.count()),
        ),
        Gauge::plain(
            "webots_simulation_draining",
            "1 while no new clients are taken",
            flag(server.is_draining()),
        ),
        Gauge::plain(
            "webots_simulation_places",
            "Simulations that fit",
            f64::from(instances.slots),
        ),
        Gauge::plain(
            "webots_simulation_places_withheld",
            "Places that are not offered because simulations are slower than they can be",
            f64::from(server.config.max_connections) - f64::from(instances.slots),
        ),
        Gauge {
            name: "webots_simulation_instances",
            help: "Simulations by state",
            labels: &["state"],
            values: by_state
                .iter()
                .map(|(state, count)| (vec![(*state).to_owned()], f64::from(*count)))
                .collect(),
        },
        Gauge {
            name: "webots_simulation_kept_ready",
            help: "Simulations that are kept ready without a client; failing: worlds of which none can be started",
            labels: &["state"],
            values: of_spares.map(|(state, count)| (vec![state.to_owned()], count)).into(),
        },
        Gauge::plain("webots_machine_cpu_percent", "CPU in use", machine.cpu),
        Gauge::plain("webots_machine_memory_percent", "Memory in use", machine.memory),
        Gauge::plain("webots_machine_swap_percent", "Swap in use", machine.swap),
        Gauge::plain(
            "webots_machine_disk_percent",
            "Disk in use where the cache is",
            machine.disk,
        ),
        Gauge::plain("webots_machine_gpu_lost", lost, flag(readings.gpu_problem.is_some())),
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
