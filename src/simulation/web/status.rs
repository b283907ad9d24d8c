//! The simulation server for other programs: `/status`.

use serde::Serialize;

use super::webots_viewer;
use crate::shared::domain::ServerReport;
use crate::simulation::config::{IsolationSetting, SandboxNetwork};
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
    pub isolation: IsolationSetting,
    /// Which network their programs have, where that is not Docker's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<SandboxNetwork>,
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
            isolation: server.launcher.level,
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
