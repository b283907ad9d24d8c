//! The project as a whole: `server.sh` and the demo as a newcomer meets them, the shipped configuration files and
//! pages, and the rules that the source keeps.

mod building;
mod configuration;
mod copy;
mod demo;
mod layering;
mod pages;
mod refusals;
