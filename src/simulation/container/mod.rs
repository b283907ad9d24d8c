//! Simulations in containers of Docker: what a project asks for, its image, and a compose project for each simulation.

mod check;
mod compose;
mod containers;
mod copy;
mod docker;
mod dockerfile;
mod image;
mod machine;
mod network;
mod objects;
pub mod packet_filter;
mod places;
mod prepared;
mod recipe;
mod steps;
mod templates;
mod tidy;
mod webots_yml;

pub use check::{check, daemon_fault};
pub use containers::{Containers, Request};
pub use objects::{Owner, sweep};
pub use prepared::Prepared;
pub use webots_yml::{Kind, WebotsYml};
