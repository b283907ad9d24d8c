//! The simulation server: one Webots per client, and no process left behind.

mod announcer;
pub mod app;
pub mod checkout;
pub mod client;
pub mod client_identity;
pub mod config;
pub mod container;
pub mod ends;
mod isolation;
pub mod machine;
pub mod preflight;
pub mod process;
pub mod protocol;
pub mod readiness;
mod relay;
pub mod sessions;
pub mod simulation_id;
pub mod slots;
pub mod snapshot;
pub mod state;
mod web;
pub mod webots;
