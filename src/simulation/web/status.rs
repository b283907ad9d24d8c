//! The page `/status`, for other programs.

use serde::Serialize;
use serde_json::{Value, json};

use super::webots_viewer;
use crate::shared::domain::ServerReport;
use crate::simulation::snapshot::Snapshot;
use crate::simulation::state::AppState;

/// The page `/status`: the part that session servers parse, and more.
#[derive(Serialize)]
struct StatusPage {
    #[serde(flatten)]
    report: ServerReport,
    #[serde(flatten)]
    more: Value,
}

/// The state of the server at this moment. Its name is empty for strangers.
pub fn status_page(server: &AppState, snapshot: &Snapshot, names_machine: bool) -> impl Serialize + use<> {
    let readings = server.readings.borrow().clone();
    let rules = &server.rules;
    let mut host = readings.host.clone();
    if !names_machine {
        host.name.clear();
    }
    let report = ServerReport {
        load: server.load(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        instances: Some(snapshot.instances),
        allowed_repositories: rules.allowed.clone(),
        blocked_repositories: rules.blocked.clone(),
        share_idle_time: rules.share_idle_time,
        docker: Some(rules.docker),
        draining: server.is_draining(),
        reserves: server.fleet_key.is_some(),
        failed_starts: server.failed_starts.count(),
        problem: server.problem(),
        ready: server.ready(),
    };
    let more = json!({
        "isolation": server.launcher.level(),
        // The network of worlds' programs; null at level `container`, where it is Docker's.
        "network": server.launcher.network(),
        // Seconds since the start.
        "uptime": server.started.elapsed().as_secs(),
        "host": host,
        "machine": readings.machine,
        "gpus": readings.gpus,
        "gpuProblem": readings.gpu_problem,
        // `places`: how many are offered because simulations are slow; null: all.
        "realTime": {"target": server.config.real_time.target, "places": server.slots.real_time_places()},
        // Pages choose the viewer by it.
        "simulator": server.config.simulator(),
        "viewer": webots_viewer::folder(&server.config).map(|_| webots_viewer::PATH),
        "simulations": snapshot.simulations,
    });
    StatusPage { report, more }
}
