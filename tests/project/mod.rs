//! The project as a whole: `server.sh` and the demo, the shipped configuration files and pages, and the rules for the
//! source.

mod building;
mod configuration;
mod copy;
mod demo;
mod layering;
mod pages;
mod reasons;
mod refusals;
mod releases;
