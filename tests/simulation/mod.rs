//! The simulation server as a black box: the built program, real git, real processes, a stand-in for Webots.

mod arrival;
mod cache;
mod checkout;
mod commits;
pub mod ends;

mod hostile;
mod https;
mod idleness;
mod large_files;
mod life;
mod limits;
mod opened;
mod own_failures;
mod passes;
mod places;
mod protocol;
mod readiness;
pub mod readings;
mod ready;
mod real_time;
mod relay;
mod resuming;
pub mod scene;
mod sentences;
mod soak;
mod spares;
mod stopping;
mod stopping_one;
mod upgrades;
mod who;
