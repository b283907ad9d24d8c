//! The session server, seen from outside: the built program, real sockets, stand-ins for simulation servers.

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
mod stand_in;
#[path = "../support/mod.rs"]
mod support;

mod door;
mod mail;
mod names;
mod placement;
mod pushing;
mod seeing;
mod stopping;
mod watching;

use stand_in::StandIn;
use support::program::Server;
use support::{http, until};

/// `HOST:PORT` of each.
fn addresses(servers: &[StandIn]) -> Vec<String> {
    servers.iter().map(StandIn::address).collect()
}

/// Waits until the session server has its simulation servers in these states, in the order of its configuration.
async fn until_states(session: &Server, expected: &[&str]) {
    until(&format!("the servers are {expected:?}"), async || {
        let status = http::get(&session.url("/status")).await.json();
        let servers = status["servers"].as_array().unwrap();
        servers.iter().map(|server| server["state"].as_str().unwrap()).eq(expected.iter().copied())
    })
    .await;
}

/// How often a server has logged this.
fn times_logged(session: &Server, words: &str) -> usize {
    session.log().matches(words).count()
}
