//! Measures the simulation server: `cargo bench --bench simulation [-- PART ...]`.
//!
//! It starts the built program, with a stand-in for the Git host, and the demo simulator instead of Webots:
//! - `load`: how fast `/load` answers while ten checkouts run, one remote hangs, and a simulator floods its output;
//! - `class`: how long 1, 10, 100 and 200 clients that start at once take, compared with a bare loop;
//! - `idle`: what idle simulations cost the server;
//! - `late`: how late the server enforces a limit that it checks itself;
//! - `start`: what a cached start costs over the git commands that it runs, what a sandbox adds to it, and how much later
//!   than its Webots is ready a client receives the URL;
//! - `stream`: how fast streams are, one and a hundred at once, through a simulation's own network and the machine's,
//!   and how much memory pasta takes; needs an ordinary user, as level `own` always does;
//! - `containers`: how long starts in containers take, one and thirty at once, compared with `docker compose up` by
//!   hand; needs root and dockerd;
//! - `relay`: what 100 streams of 50 messages a second cost through the server, through nginx, and directly, and how
//!   late an echo is beside six streams that are as fast as possible; needs
//!   nginx;
//! - `soak`: whether a thousand starts and stops in a row leave anything: processes, file descriptors, ports, folders,
//!   threads, memory.
//!
//! It fails if a bound is exceeded. Other load of the machine affects the results.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a measurement that fails ends with a panic"
)]

mod class;
mod containers;
mod idle;
mod late;
mod load;
mod relay;
#[path = "../../tests/simulation/soak.rs"]
mod soak;
mod start;
mod stream;
#[path = "../../tests/support/mod.rs"]
mod support;
#[allow(dead_code, reason = "tests use more of it")]
#[path = "../../tests/proxy/web_server.rs"]
mod web_server;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};

#[derive(Parser)]
struct Arguments {
    /// What to measure; everything, if nothing is named.
    #[arg(value_enum)]
    parts: Vec<Part>,
    /// Starts in a row for `soak`.
    #[arg(long, default_value_t = 1000)]
    starts: usize,
    /// Requests of each row of `load`.
    #[arg(long, default_value_t = 2000)]
    requests: usize,
    /// Cached starts for `start`.
    #[arg(long, default_value_t = 100)]
    cached: usize,
    /// How many start at once in `class`, in place of 1, 10, 100 and 200, or in `containers`, in place of 1 and 30, or run in
    /// `late`, in place of 10 and 100, or in `stream`, in place of 1 and 100.
    #[arg(long)]
    size: Vec<u16>,
    /// Levels of isolation for `class`, `idle` and `late`, in place of `none` and `sandbox`. `own` is a sandbox with a network
    /// of its own.
    #[arg(long)]
    level: Vec<String>,
    /// Rounds of each row of `class` and `containers`.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Seconds of each row of `idle` and `stream`.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// cargo adds this.
    #[arg(long, hide = true)]
    bench: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    Class,
    Idle,
    Late,
    Load,
    Start,
    Stream,
    Containers,
    Relay,
    Soak,
}

/// Whether each bound was kept.
#[derive(Default)]
struct Verdict {
    failed: bool,
}

impl Verdict {
    fn bound(&mut self, what: &str, value: Duration, most: Duration) {
        let kept = value <= most;
        self.failed |= !kept;
        println!(
            "  {} {what}: {value:.3?}, bound {most:?}",
            if kept { "kept  " } else { "BROKEN" }
        );
    }

    fn ratio(&mut self, what: &str, value: f64, most: f64) {
        let kept = value <= most;
        self.failed |= !kept;
        println!(
            "  {} {what}: {value:.2}, bound {most}",
            if kept { "kept  " } else { "BROKEN" }
        );
    }
}

#[actix_rt::main]
async fn main() -> ExitCode {
    if relay::is_sender() {
        relay::send().await;
    }
    let arguments = Arguments::parse();
    let is_wanted = |part| arguments.parts.is_empty() || arguments.parts.contains(&part);
    let mut verdict = Verdict::default();
    let all = || ["none", "sandbox"].map(str::to_owned).to_vec();
    let levels = if arguments.level.is_empty() {
        all()
    } else {
        arguments.level
    };
    if is_wanted(Part::Load) {
        load::measure(&mut verdict, arguments.requests).await;
    }
    if is_wanted(Part::Start) {
        start::measure(&mut verdict, arguments.cached).await;
        start::compare_levels(&mut verdict, arguments.cached).await;
        start::follow_loads(&mut verdict, arguments.cached.min(30)).await;
    }
    if is_wanted(Part::Class) {
        let sizes = if arguments.size.is_empty() {
            vec![1, 10, 100, 200]
        } else {
            arguments.size.clone()
        };
        class::measure(&mut verdict, &levels, &sizes, arguments.rounds).await;
    }
    if is_wanted(Part::Idle) {
        idle::measure(&mut verdict, &levels, Duration::from_secs(arguments.seconds)).await;
    }
    if is_wanted(Part::Late) {
        late::measure(&levels, &arguments.size).await;
    }
    if is_wanted(Part::Stream) {
        stream::measure(&arguments.size, Duration::from_secs(arguments.seconds)).await;
    }
    if is_wanted(Part::Containers) {
        let sizes = if arguments.size.is_empty() {
            &[1, 30][..]
        } else {
            &arguments.size
        };
        containers::measure(&mut verdict, sizes, arguments.rounds).await;
    }
    if is_wanted(Part::Relay) {
        relay::measure(&mut verdict, Duration::from_secs(arguments.seconds), arguments.rounds).await;
    }
    if is_wanted(Part::Soak) {
        soak_and_tell(&mut verdict, arguments.starts).await;
    }
    if verdict.failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}

async fn soak_and_tell(verdict: &mut Verdict, starts: usize) {
    let begin = Instant::now();
    let (before, after) = soak::soak(starts, 1).await;
    println!("{starts} starts and stops in {:.0?}", begin.elapsed());
    println!("{:<24}{:>10}{:>10}", "", "before", "after");
    for ((name, before), (_, after)) in before.rows().iter().zip(after.rows()) {
        println!("{name:<24}{before:>10}{after:>10}");
    }
    let leaks = after.leaks_since(&before, starts);
    for leak in &leaks {
        println!("  BROKEN {leak}");
    }
    verdict.failed |= !leaks.is_empty();
}
