//! The simulation server, seen from outside: the built program, real git, real processes, a stand-in for Webots.

mod admission;
mod cache;
mod checkout;
mod commits;
pub mod ends;
mod fetching;
mod git_wrapper;
mod https;
mod idleness;
mod large_files;
mod life;
mod limits;
#[allow(dead_code, reason = "faults use more of it")]
#[path = "../faults/network.rs"]
mod network;
mod opened;
mod own_failures;
mod places;
mod protocol;
mod readiness;
pub mod readings;
mod ready;
mod relay;
mod resuming;
pub mod scene;
mod soak;
mod stopping;
mod stopping_one;
mod trees;
mod who;
