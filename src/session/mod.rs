//! The session server: the entry point to a fleet of simulation servers.

pub mod app;
pub mod class;
pub mod config;
pub mod fleet;
pub mod line;
pub mod mail;
pub mod placement;
mod state;
pub mod web;
