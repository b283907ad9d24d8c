//! The simulation server: one Webots per client, and no process left behind.

mod announcer;
pub mod app;
pub mod attachment;
pub(crate) mod checkout;
pub mod client;
pub mod client_identity;
pub mod config;
pub mod container;
pub(crate) mod ends;
mod isolation;
pub mod machine;
pub mod preflight;
pub mod process;
pub(crate) mod progress;
pub mod protocol;
pub(crate) mod readiness;
mod relay;
pub(crate) mod simulated_time;
pub(crate) mod simulation_id;
pub(crate) mod slots;
pub mod snapshot;
pub mod spare_wishes;
pub mod state;
mod web;
pub(crate) mod webots;
