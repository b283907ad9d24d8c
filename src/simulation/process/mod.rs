//! The processes and directories of simulations: how they are started, measured and removed.

pub mod disk_usage;
pub mod guardian;
mod instance_dir;
mod lines;
mod own_fault;
mod process_group;
pub mod process_tree;
mod runner;

pub use disk_usage::DiskRoom;
pub use guardian::Guardian;
pub use instance_dir::{InstanceDir, RunDir, has_several_runs, is_alive, remove, remove_tree, runs_in};
pub use lines::Lines;
pub use own_fault::{disk_fault, own_call_failed, start_fault};
pub use process_group::{Cause, ExitReason, ProcessGroup, SpawnSpec};
pub use runner::{Ran, Run, RunError, on_own_thread};
