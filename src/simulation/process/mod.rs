//! What a simulation leaves in the system, and how it is removed: process trees and folders.

pub mod folder_size;
pub mod guardian;
mod instance_dir;
mod lines;
mod process_group;
pub mod process_tree;
mod remove_tree;

pub use guardian::Guardian;
pub use instance_dir::{InstanceDir, Leftovers, RunDir};
pub use lines::Lines;
pub use process_group::{ExitReason, ProcessGroup, SpawnSpec};
pub use remove_tree::remove_tree;
