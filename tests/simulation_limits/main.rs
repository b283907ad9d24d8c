//! What black-box tests of the simulation server can't reach: its time limit, because the configuration allows no less
//! than six minutes, and panics of its actors. This program runs the server itself. It has a `main` of its own because
//! the server starts its own program as guardian of each Webots.

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

mod inside;
mod panics;
mod time;

use std::future::Future;

use clap::Parser;
use webots_fleet::simulation::process::guardian;

#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    part: Part,
}

#[derive(clap::Subcommand)]
enum Part {
    Guard(guardian::Arguments),
}

fn main() {
    if std::env::args().nth(1).as_deref() == Some("guard") {
        let Part::Guard(arguments) = Arguments::parse().part;
        std::process::exit(guardian::guard(&arguments, || ()).into());
    }
    let has_run = [
        run(
            "time::a_simulation_ends_at_its_time_limit_in_any_state",
            time::a_simulation_ends_at_its_time_limit_in_any_state,
        ),
        run(
            "time::who_is_away_at_the_time_limit_hears_it",
            time::who_is_away_at_the_time_limit_hears_it,
        ),
        run(
            "panics::a_client_leaves_nothing_in_any_state",
            panics::a_client_leaves_nothing_in_any_state,
        ),
        run(
            "panics::a_session_leaves_nothing_in_any_state",
            panics::a_session_leaves_nothing_in_any_state,
        ),
        run(
            "panics::a_webots_leaves_nothing_and_its_client_is_told",
            panics::a_webots_leaves_nothing_and_its_client_is_told,
        ),
        run(
            "panics::an_actor_that_must_live_ends_the_server",
            panics::an_actor_that_must_live_ends_the_server,
        ),
    ];
    if !has_run.contains(&true) {
        eprintln!("no test has such a name: arguments are parts of names, or flags in one word, which are ignored");
        std::process::exit(1);
    }
}

/// Runs a test, unless the command line names only others. Returns whether it has run.
fn run<F: Future<Output = ()>>(name: &str, test: fn() -> F) -> bool {
    let mut wanted = std::env::args()
        .skip(1)
        .filter(|argument| !argument.starts_with('-'))
        .peekable();
    let is_wanted = wanted.peek().is_none() || wanted.any(|part| name.contains(&part));
    if is_wanted {
        actix_rt::System::new().block_on(test());
        println!("test {name} ... ok");
    }
    is_wanted
}
