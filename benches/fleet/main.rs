//! Measures the session server in front of a large fleet: `cargo bench --bench fleet`.
//!
//! It starts the built program with stand-ins for simulation servers in this process, and measures
//! 1. how long `/session` takes with 10 servers, with one of ten hung, and with 1,000 servers, in turns;
//! 2. how much processor time the server needs to probe 10 and 1,000 servers each second;
//! 3. how long a change takes to reach 10,000 connected clients;
//! 4. how many requests it answers on 64 connections, compared with a bare handler of actix, in turns (by `wrk`);
//! 5. how much memory an idle WebSocket client costs, compared with one bare actor per client;
//! 6. what 5,000 clients in the line cost: memory, and processor time while it stands still and while it moves.
//!
//! `cargo bench --bench fleet -- door`, `watch`, `push`, `storm`, `idle` or `line` measures one of them. It fails if a bound is
//! exceeded; a missed goal is only reported.
//! Other load of the machine affects the results: each part also prints a reference measurement.

#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a measurement that can't go on ends"
)]

mod bare;
mod door;
mod idle;
mod line;
mod push;
mod server;
mod stand_ins;
mod storm;
#[allow(
    missing_docs,
    unreachable_pub,
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    reason = "these are the tools of tests"
)]
#[path = "../../tests/support/mod.rs"]
mod support;
mod watch;

use std::process::ExitCode;

/// Whether each bound was kept.
#[derive(Default)]
struct Verdict {
    failed: bool,
}

impl Verdict {
    fn bound(&mut self, what: &str, value: f64, most: f64, unit: &str) {
        let kept = value <= most;
        self.failed |= !kept;
        println!(
            "  {} {what}: {value:.2} {unit}, bound {most} {unit}",
            if kept { "kept  " } else { "BROKEN" }
        );
    }
}

/// Prints whether a goal is reached.
fn goal(what: &str, is_reached: bool, found: &str) {
    println!("  {} {what}: {found}", if is_reached { "reached" } else { "MISSED " });
}

fn main() -> ExitCode {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| !argument.starts_with('-'))
        .collect();
    if wanted.iter().any(|name| name == bare::ARGUMENT) {
        bare::serve().expect("a port of the loopback is free");
        return ExitCode::SUCCESS;
    }
    let is_wanted = |part: &str| wanted.is_empty() || wanted.iter().any(|name| name == part);
    server::raise_file_limit();
    let mut verdict = Verdict::default();
    if is_wanted("door") {
        door::measure(&mut verdict);
    }
    if is_wanted("watch") {
        watch::measure(&mut verdict);
    }
    if is_wanted("push") {
        push::measure(&mut verdict);
    }
    if is_wanted("storm") {
        storm::measure();
    }
    if is_wanted("idle") {
        idle::measure();
    }
    if is_wanted("line") {
        line::measure(&mut verdict);
    }
    if verdict.failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}
