//! Simulations in Docker containers: what a project requests, its image, and a compose project for each simulation.

mod build_plan;
mod builders;
mod built_image;
mod compose_project;
mod container_service;
mod docker;
mod dockerfile;
mod engine;
mod failures;
mod growth;
mod image;
mod image_store;
mod network;
mod owned_resources;
pub mod packet_filter;
mod simulation_containers;
mod usage;
mod webots_yml;

pub use built_image::RUNS;
pub use compose_project::ContainerRequest;
pub use container_service::{ContainerService, check};
pub use docker::{daemon_fault, data_folder, docker_disk_fault};
pub use image_store::ImageUse;
pub use owned_resources::{ResourceOwner, sweep_all};
pub use simulation_containers::SimulationContainers;
pub use usage::measure;
pub use webots_yml::{ProjectKind, WebotsYml};
