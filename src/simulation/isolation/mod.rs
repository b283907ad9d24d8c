//! The launch of a simulation: its isolation level, environment and limits, and what ends with it.

mod cgroup;
mod disk;
mod disk_use;
mod display;
mod inherited_environment;
mod keyrings;
mod launcher;
mod mount;
mod network;
mod peak;
mod program;
mod sandbox;
mod watcher;

pub use cgroup::Cgroup;
pub use disk_use::DiskUse;
pub use display::Display;
pub use launcher::Launcher;
pub use peak::Peak;
pub use program::Program;
pub use watcher::{Watch, Watcher};
