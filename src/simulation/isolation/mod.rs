//! How a simulation is launched: at which level of isolation, with which environment and limits, and what ends with it.

mod cgroup;
mod disk;
mod disk_use;
mod display;
mod environment;
mod launcher;
mod peak;
mod place;
mod program;
mod sandbox;
mod unkept;
mod watcher;

pub use cgroup::Cgroup;
pub use display::{Display, SCREEN};
pub use launcher::{Launcher, Level};
pub use peak::Peak;
pub use program::Program;
pub use watcher::{Watch, Watcher};
