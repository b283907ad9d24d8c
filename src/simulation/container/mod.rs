//! Simulations in containers: what a project asks for, and what must hold on the machine.

pub mod packet_filter;
mod webots_yml;

pub use webots_yml::{Kind, WebotsYml};
