//! What a service manager, an administrator and a display see of the servers.

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

mod display;
mod drain;
mod files;
mod notify;
mod ports;
mod preflight;
