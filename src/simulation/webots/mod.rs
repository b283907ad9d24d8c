//! A running Webots: its command line, its output, and the actor that watches over it.

mod command;
mod event;
mod idleness;
mod launch_spec;
mod launched;
mod output;
mod paced_reader;
mod runtime;
mod verdict;
mod virtual_display;
mod webots;

pub use event::{Exit, WebotsEvent};
pub use idleness::Keep;
pub use launch_spec::LaunchSpec;
pub use webots::{RestoreController, Stop, Webots};
