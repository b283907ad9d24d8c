//! The fleet behind real web servers: Debian's apache2 and nginx, started here on free ports of the loopback, with our
//! rules (`deploy/`) and with those of the original documents.

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

#[path = "../mail/smtp.rs"]
#[expect(dead_code, reason = "the tests of mails use the rest")]
mod smtp;
#[path = "../support/mod.rs"]
mod support;

mod authority;
mod browser;
mod fleet;
mod rules;
mod web_server;

mod addresses;
mod connections;
mod encoded;
mod exposure;
mod pages;
mod trust;
mod urls;
mod visitor;
mod whole_way;
