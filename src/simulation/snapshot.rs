//! A snapshot of all simulations of this server, for pages and programs.

use std::path::PathBuf;

use actix::prelude::*;
use serde::Serialize;

use crate::shared::domain::Instances;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::simulation_id::SimulationId;

/// A change of a simulation.
#[derive(Debug)]
pub enum SimulationChange {
    /// It is in another state.
    Stage(Stage),
    /// Its world was made for this version of Webots.
    Version(String),
    /// Its process was started: it was granted this port, and its output is kept in this file.
    Launched {
        /// When, in seconds since 1970.
        at: u64,
        /// The root of its process tree.
        pid: i32,
        /// The directory of its control group, if it has one.
        cgroup: Option<PathBuf>,
        /// The port that was granted.
        port: u16,
        /// The file.
        log: Option<PathBuf>,
    },
    /// It was given the GPU with this number.
    Gpu(u32),
    /// Its client has disconnected, and it waits until this time, in seconds since 1970; `None` if its client is
    /// connected again.
    Away(Option<u64>),
}

/// The states of a simulation, as pages and programs see them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// In the queue.
    Queued,
    /// Its project is checked out.
    CheckingOut,
    /// Webots is starting.
    Launching,
    /// Webots runs, the simulation is paused.
    Idle,
    /// The simulation runs.
    Running,
    /// Webots is ending.
    Stopping,
}

/// All simulations at one moment.
#[derive(Debug, Clone, Default, MessageResponse)]
pub struct Snapshot {
    /// The numbers by state.
    pub instances: Instances,
    /// Each simulation, sorted by id.
    pub simulations: Vec<Simulation>,
}

/// One simulation, as pages and programs see it.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Simulation {
    /// Its id; unique.
    pub id: SimulationId,
    /// The world's URL.
    pub world: String,
    /// Its client's identity, only for administrators.
    #[serde(skip)]
    pub identity: ClientIdentity,
    /// Its state.
    pub stage: Stage,
    /// When its client requested it, in seconds since 1970.
    pub since: u64,
    /// When it was launched, in seconds since 1970; the time limit starts then.
    pub launched: Option<u64>,
    /// The root of its process tree, once it is launched.
    pub pid: Option<i32>,
    /// The directory of its control group, if it has one.
    #[serde(skip)]
    pub cgroup: Option<PathBuf>,
    /// The streaming port, once there is one.
    pub port: Option<u16>,
    /// The number of its GPU, where simulations are spread over several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpu: Option<u32>,
    /// Until when it waits for its client, which is away, in seconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub away_until: Option<u64>,
    /// The version of Webots that the world was made for.
    pub version: Option<String>,
    /// The file that its output is kept in.
    pub log: Option<PathBuf>,
}

impl Simulation {
    /// Applies a change.
    pub fn apply(&mut self, change: SimulationChange) {
        match change {
            SimulationChange::Stage(stage) => self.stage = stage,
            SimulationChange::Version(version) => self.version = Some(version),
            SimulationChange::Gpu(index) => self.gpu = Some(index),
            SimulationChange::Away(until) => self.away_until = until,
            SimulationChange::Launched { at, pid, cgroup, port, log } => {
                self.cgroup = cgroup;
                self.launched = Some(at);
                self.pid = Some(pid);
                self.port = Some(port);
                self.log = log;
                self.stage = Stage::Launching;
            }
        }
    }
}
