//! A running Webots: its command line, its output, and the actor that watches over it.

mod command;
mod event;
mod launch_spec;
mod output;
mod webots;

pub use event::{Exit, WebotsEvent};
pub use launch_spec::Orders;
pub use webots::{End, RestoreController, Webots};
