//! The machine: CPU, memory, disk, network, GPUs and display, and its load.

pub mod display;
mod gpus;
mod load_monitor;
pub mod sensors;
mod spread;
mod usage;

pub use load_monitor::{LoadMonitor, Readings};
pub use spread::Spread;
pub use usage::{Usage, UsageMonitor, Usages, usages};
