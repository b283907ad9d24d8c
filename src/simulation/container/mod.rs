//! Simulations in Docker containers: what a project requests, its image, and a compose project for each simulation.

mod build_plan;
mod built_image;
mod check;
mod compose_project;
mod container_service;
mod docker;
mod dockerfile;
mod image;
mod image_export;
mod owned_resources;
pub mod packet_filter;
mod project_paths;
mod simulation_containers;
mod start_error;
mod templates;
mod usage;
mod webots_yml;

pub use built_image::RUNS;
pub use check::{check, check_templates, daemon_fault, data_folder};
pub use compose_project::ContainerRequest;
pub use container_service::ContainerService;
pub use owned_resources::{ResourceOwner, sweep_all};
pub use simulation_containers::{Cause, SimulationContainers};
pub use start_error::StartError;
pub use usage::measure;
pub use webots_yml::{ProjectKind, WebotsYml};
