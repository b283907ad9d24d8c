//! Input of any kind: what the readers of foreign texts do with mutations of committed examples (`seeds/`). None may
//! panic, take long, or let through what breaks a rule.
//!
//! `INPUTS=1000000 cargo test --test integration inputs::` runs a million cases of each. A case that has failed is kept in
//! `regressions.txt` beside this file, and is tried first from then on. What Webots prints is tried where it is read:
//! `PROPTEST_CASES=1000000 cargo test --lib every_line_is_short`.

mod client_message;
mod configuration;
mod forwarded;
mod mutations;
mod report;
mod webots_yml;
mod world_url;

use std::time::Duration;

use nix::time::ClockId;
use proptest::test_runner::{Config, FileFailurePersistence, TestRunner};

/// How many cases of each kind are tried where nothing else is asked for.
const CASES: u32 = 3_000;
/// How much processor time one case may take, whatever else runs on the machine. A reader that hangs takes more.
const BOUND: Duration = Duration::from_secs(2);

/// Tries a check with mutations of the lines of `seeds`. The check panics where a rule is broken.
fn try_many(seeds: &'static str, check: impl Fn(&[u8])) {
    let cases = std::env::var("INPUTS").map_or(CASES, |text| text.parse().unwrap());
    let failure_persistence = Some(Box::new(FileFailurePersistence::Direct("tests/inputs/regressions.txt")) as _);
    let mut runner = TestRunner::new(Config { cases, failure_persistence, ..Config::default() });
    let checked = runner.run(&mutations::of(seeds), |input| {
        let began = processor_time();
        check(&input);
        let took = processor_time() - began;
        assert!(took < BOUND, "it took {took:?}");
        Ok(())
    });
    checked.unwrap_or_else(|failure| panic!("{failure}"));
}

/// The processor time of this thread.
fn processor_time() -> Duration {
    ClockId::CLOCK_THREAD_CPUTIME_ID.now().unwrap().into()
}

/// Whether a text is one line that a terminal or a page shows as it is.
fn is_one_line(text: &str) -> bool {
    !text.chars().any(char::is_control)
}
