//! Simulations in containers: the built simulation server with a real Docker daemon, which these tests start, and
//! images that they build under the names of the real ones. Needs root; without it the tests are skipped.

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

#[macro_use]
#[path = "../support/mod.rs"]
mod support;

mod builds;
mod daemon;
mod deeds;
mod ends;
mod hostile;
mod image;
mod kinds;
mod life;
mod page;
mod ready;
mod registry;
