//! Simulations in containers of Docker: what a project asks for, its image, and a compose project for each simulation.

mod blocking;
mod check;
mod compose;
mod containers;
mod copy;
mod docker;
mod dockerfile;
mod engine;
mod image;
mod network;
mod objects;
mod opened;
pub mod packet_filter;
mod places;
mod prepared;
mod project_file;
mod project_images;
mod prune;
mod recipe;
mod request;
mod start_error;
mod steps;
mod templates;
mod tidy;
mod usage;
mod webots_yml;

pub use check::{check, check_templates, daemon_fault, data_folder, init_fault};
pub use containers::Containers;
pub use objects::{Owner, sweep};
pub use opened::RUNS;
pub use prepared::{Cause, Prepared};
pub use request::Request;
pub use start_error::StartError;
pub use usage::measure;
pub use webots_yml::{Kind, WebotsYml};
