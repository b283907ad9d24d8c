//! The simulation server's configuration: every key, its default, and the rules between keys.

mod simulation_config;
mod timing;

pub use simulation_config::SimulationConfig;
pub use timing::Timing;
