//! The launch of a simulation: its isolation level, environment and limits, and what ends with it.

mod assets;
mod cgroup;
mod disk;
mod display;
mod launcher;
mod mount;
mod names;
mod network;
mod sandbox;
mod system_calls;
mod watcher;

pub use assets::RepositoryAssets;
pub use cgroup::Cgroup;
pub use disk::DiskUse;
pub use display::Display;
pub use launcher::Launcher;
pub use watcher::Watcher;
