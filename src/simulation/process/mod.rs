//! What a simulation uses of the system, and how it is removed: process trees and directories.

mod answer;
mod disk_room;
pub mod disk_usage;
pub mod guardian;
mod instance_dir;
mod lines;
mod own_thread;
mod process_group;
pub mod process_tree;
mod remove_tree;
mod runner;

pub use answer::until_answering;
pub use disk_room::DiskRoom;
pub use guardian::Guardian;
pub use instance_dir::{InstanceDir, RunDir};
pub use lines::Lines;
pub use own_thread::on_own_thread;
pub use process_group::{ExitReason, ProcessGroup, SpawnSpec};
pub use remove_tree::remove_tree;
pub use runner::{Ran, Run, RunError};
