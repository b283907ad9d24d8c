//! A running Webots: its command line, its output, and its actor.

mod event;
mod idleness;
mod launch_spec;
mod launched;
mod output;
mod release;
mod startup;
mod webots;

pub use event::WebotsEvent;
pub use idleness::Keep;
pub use launch_spec::LaunchSpec;
pub use release::Release;
pub use webots::{HasClient, Stop, Webots};
