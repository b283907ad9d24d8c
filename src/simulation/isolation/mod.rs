//! The launch of a simulation: its isolation level, environment and limits, and what ends with it.

mod assets;
mod cgroup;
mod disk;
mod disk_monitor;
mod display;
mod launcher;
mod mount;
mod names;
mod network;
mod sandbox;
mod system_calls;

pub use assets::RepositoryAssets;
pub use cgroup::Cgroup;
pub use disk::DiskUse;
pub use disk_monitor::DiskMonitor;
pub use display::Display;
pub use launcher::{IsolationLevel, Launcher, Network};
