//! A snapshot of all simulations of this server, for pages and programs.

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

#[cfg(test)]
use crate::shared::domain::ProjectUrl;
use crate::shared::domain::{Instances, Stage};
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::simulated_time::SimulatedTime;
use crate::simulation::simulation_id::SimulationId;

/// The 3D scene that a Webots streams. It does not answer a viewer that requests the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneKind {
    /// Until R2023b.
    X3d,
    /// Since R2025a.
    W3d,
}

impl SceneKind {
    /// The message with which a viewer requests it.
    pub fn request(self) -> &'static str {
        match self {
            Self::X3d => "x3d",
            Self::W3d => "w3d",
        }
    }
}

/// All simulations at one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    /// The numbers by state.
    pub instances: Instances,
    /// Each simulation that has a client: first those of older processes, sorted by id within each process.
    pub simulations: Vec<Simulation>,
}

/// What a process of this server has, as it tells the one that has the port.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Holdings {
    /// The ports that it may use.
    pub ports: BTreeSet<u16>,
    /// The numbers by state.
    pub instances: Instances,
    /// Each simulation that has a client.
    pub simulations: Vec<Simulation>,
}

impl Holdings {
    /// Adds those of another process.
    pub fn add(&mut self, other: &Self) {
        self.ports.extend(&other.ports);
        self.instances.add(&other.instances);
        self.simulations.extend_from_slice(&other.simulations);
    }
}

/// One simulation, as pages and programs see it: made of its record in the slot pool, which holds its states.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Simulation {
    /// Its id; unique.
    pub id: SimulationId,
    /// The world's URL.
    pub world: String,
    /// The URL of its repository.
    #[serde(skip)]
    pub repository: String,
    /// Its client's identity, only for administrators.
    #[serde(flatten)]
    pub identity: ClientIdentity,
    /// Its state.
    pub stage: Stage,
    /// When its client requested it, in seconds since 1970.
    pub since: u64,
    /// When it was launched, or taken by its client if it was kept ready, in seconds since 1970; the time limit starts then.
    pub launched: Option<u64>,
    /// The root of its process tree, once it is launched.
    pub pid: Option<i32>,
    /// The streaming port, once there is one.
    pub port: Option<u16>,
    /// Seconds for which its client has waited for the slot, once it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub waited: Option<f64>,
    /// The number of its GPU, if simulations are spread over several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpu: Option<u32>,
    /// When it stops waiting for its disconnected client, in seconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub away_until: Option<u64>,
    /// The version of Webots that the world was made for.
    pub version: Option<String>,
    /// The 3D scene that its Webots streams, once that is known; none for a video.
    #[serde(skip)]
    pub scene: Option<SceneKind>,
    /// How fast it runs: simulated seconds per second, if its stream is relayed.
    #[serde(rename = "realTime")]
    pub time: SimulatedTime,
    /// The file that its output is kept in.
    pub log: Option<PathBuf>,
}

#[cfg(test)]
impl Simulation {
    /// One that a client has just requested.
    pub fn new(id: SimulationId, world: &ProjectUrl, identity: ClientIdentity) -> Self {
        Self {
            id,
            world: world.to_string(),
            repository: world.repository(),
            identity,
            stage: Stage::Queued,
            since: crate::shared::run::seconds_since_1970(),
            launched: None,
            pid: None,
            port: None,
            waited: None,
            gpu: None,
            away_until: None,
            version: None,
            scene: None,
            time: SimulatedTime::default(),
            log: None,
        }
    }
}
