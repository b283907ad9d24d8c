//! What a simulation leaves in the system, and how it is removed: process trees and folders.

pub mod guardian;
mod instance_dir;
pub mod orphans;
pub mod process_group;
pub mod process_tree;
mod x_lock;

pub use instance_dir::{InstanceDir, RunDir, Swept};
