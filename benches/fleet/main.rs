//! Measures the session server in front of a large fleet: `cargo bench --bench fleet`.
//!
//! It starts the built program with stand-ins for simulation servers in this process, and measures
//! 1. how long `/session` takes with 10 servers, with one of ten hung, and with 1,000 servers, in turns;
//! 2. how much processor time the server needs to watch 10 and 1,000 servers each second;
//! 3. how long it takes until 10,000 connected clients know of a change.
//!
//! `cargo bench --bench fleet -- door`, `watch` or `push` measures one of them. It fails if a bound is not kept.
//! What else runs on the machine counts too: each part prints a yardstick that was measured beside it.

#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a measurement that can't go on ends"
)]

mod door;
mod push;
mod server;
mod stand_ins;
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
        println!("  {} {what}: {value:.2} {unit}, bound {most} {unit}", if kept { "kept  " } else { "BROKEN" });
    }
}

fn main() -> ExitCode {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
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
    if verdict.failed { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}
