//! The steps of a checkout, for its client. Pure.
//!
//! The fetch takes most of the time, so the progress bar of Webots' page gets several of nine steps for it, by the
//! percentage that git reports.

use crate::simulation::progress::{MAX_STEPS, Progress, Step};

/// The first and the last step of a fetch; the steps between them follow the received objects.
const FETCH: (u64, u64) = (2, 7);

fn step(step: Step, number: u64, percent: Option<u8>, text: String) -> Progress {
    Progress {
        step,
        percent,
        text,
        of_all: Some((number, MAX_STEPS)),
    }
}

/// The phase and the percentage of a line of git, as `Receiving objects:  40% (2/5)`.
fn phase(line: &str) -> Option<(&str, u8)> {
    let (phase, rest) = line.split_once(':')?;
    let percent: u8 = rest.split_once('%')?.0.trim().parse().ok()?;
    Some((phase, percent.min(100)))
}

/// The remote is queried.
pub fn looking_for(repository: &str) -> Progress {
    step(Step::Search, 1, None, format!("looking for {repository}"))
}

/// git fetches, and prints this line.
pub fn fetching(what: &str, line: &str) -> Progress {
    let (first, last) = FETCH;
    let phase = phase(line);
    let number = match phase {
        Some(("Receiving objects", percent)) => first + (last - first) * u64::from(percent) / 100,
        Some(("Resolving deltas", _)) => last,
        _ => first,
    };
    let percent = phase.map(|(_, percent)| percent);
    step(Step::Fetch, number, percent, format!("fetching {what}: {line}"))
}

/// git writes the files of a branch, tag or commit, and prints this line.
pub fn checking_out(name: &str, line: &str) -> Progress {
    let percent = phase(line).map(|(_, percent)| percent);
    let text = format!("checking {name} out {line}").trim_end().to_owned();
    step(Step::Write, 8, percent, text)
}

/// The files are there. Webots' page takes a text that ends in `done` for the end of a step.
pub fn done() -> Progress {
    Progress::new(Step::Done, "checkout done")
}
