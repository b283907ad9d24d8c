//! The black-box tests: built programs, real sockets, processes and files. One crate, so that they are linked only
//! once; `cargo test --test integration proxy::` runs one part.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::string_slice,
    reason = "tests fail by panics"
)]
#![allow(clippy::pedantic, reason = "tests are read one by one")]

#[macro_use]
mod support;

mod demo_simulator;
mod deploy;
mod inputs;
mod isolation;
mod placement;
mod project;
mod proxy;
mod rehearsal;
mod session;
mod simulation;
