//! The simulation server: one Webots per client, none left behind.

pub mod announcer;
pub mod app;
pub mod checkout;
pub mod command;
pub mod config;
pub mod git;
pub mod guardian;
pub mod instance_dir;
pub mod load_monitor;
pub mod mirrors;
pub mod output;
pub mod page_routes;
pub mod pages;
pub mod places;
pub mod process_group;
pub mod process_tree;
pub mod protocol;
pub mod repository_cache;
pub mod revision;
pub mod routes;
pub mod sensors;
pub mod status;
pub mod usage;
pub mod web_client;
pub mod webots;
pub mod world_file;
