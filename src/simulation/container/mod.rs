//! Simulations in containers: what a project asks for, and what must hold on the machine.

mod webots_yml;

pub use webots_yml::{Kind, WebotsYml};
