//! The simulation server, seen from outside: the built program, real git, real processes, a stand-in for Webots.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests fail by panics"
)]
#![allow(clippy::pedantic, reason = "tests are read one by one")]

#[path = "../support/mod.rs"]
mod support;

mod admission;
mod cache;
mod checkout;
mod commits;
mod fetching;
mod git_wrapper;
mod https;
mod life;
mod output;
mod places;
mod protocol;
mod readings;
mod ready;
mod scene;
mod soak;
mod stopping;
mod trees;
