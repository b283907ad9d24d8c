//! The session server: the one door to a fleet of simulation servers.

mod announcements;
pub mod app;
pub mod config;
pub mod fleet;
pub mod mail;
pub mod placement;
mod state;
pub mod web;
