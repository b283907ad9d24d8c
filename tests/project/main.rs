//! The project as a whole: `server.sh` and the demo as a newcomer meets them, the shipped configuration files and
//! pages, and the rules that the source keeps.

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

#[path = "../support/mod.rs"]
mod support;

mod configuration;
mod copy;
mod demo;
mod layering;
mod pages;
mod refusals;
mod source;
