//! The simulation server's configuration: every key, its default, and the rules between keys.

mod container;
mod isolation;
mod mirrors;
mod resources;
mod simulation_config;
mod timing;
mod urls;

pub use container::{ContainerDisplay, ContainerNetwork, ContainerSettings, EDITOR_PORT};
pub use isolation::{IsolationSetting, SandboxFolders, SandboxNetwork, VariableName};
pub use mirrors::{Mirrors, Remote};
pub use resources::{GpuUse, RealTime, ResourceLimits};
pub use simulation_config::SimulationConfig;
pub use timing::Timing;
pub use urls::Streaming;
