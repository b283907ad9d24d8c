//! Black-box tests of the session server: the built program, real sockets, stand-ins for simulation servers.

mod stand_in;

mod announcing;
mod class;
mod discovery;
mod door;
mod fleet_line;
mod keeping_ready;
mod mail;
mod memory;
mod placement;
mod pushing;
mod requests;
mod seeing;
mod signing_in;
mod slots;
mod stopping;
mod trust;
mod waiting;
mod watching;
mod webhook;

use crate::support::program::Server;
use crate::support::until;
use stand_in::StandIn;

/// `HOST:PORT` of each.
fn addresses(servers: &[StandIn]) -> Vec<String> {
    servers.iter().map(StandIn::address).collect()
}

/// Waits until the session server has its simulation servers in these states, in the order of its configuration.
async fn until_states(session: &Server, expected: &[&str]) {
    until(&format!("the servers are {expected:?}"), async || {
        let status = session.status().await;
        let servers = status["servers"].as_array().unwrap();
        servers
            .iter()
            .map(|server| server["state"].as_str().unwrap())
            .eq(expected.iter().copied())
    })
    .await;
}

/// The number of times that a server has logged this.
fn times_logged(session: &Server, words: &str) -> usize {
    session.log().matches(words).count()
}
