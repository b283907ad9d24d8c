//! The steps of a checkout, as text for its client. Pure.
//!
//! Webots' page moves its progress bar by texts such as `Step 3/9 : ...`, in which each number has one digit, and by
//! one that ends in `done`. The fetch takes most of the time, so it has several steps, by the percentage that git
//! reports.

/// Number of steps.
const STEPS: u64 = 9;
/// The first and the last step of a fetch; the steps between them follow the received objects.
const FETCH: (u64, u64) = (2, 7);

fn step(number: u64, what: &str) -> String {
    format!("Step {number}/{STEPS} : {what}")
}

/// The remote is queried.
pub fn looking_for(repository: &str) -> String {
    step(1, &format!("looking for {repository}"))
}

/// git fetches, and prints this line.
pub fn fetching(what: &str, line: &str) -> String {
    let (first, last) = FETCH;
    let percent = |text: &str| text.split_once('%')?.0.trim().parse::<u64>().ok();
    let number = match line.split_once(':') {
        Some(("Receiving objects", rest)) => first + (last - first) * percent(rest).unwrap_or(0).min(100) / 100,
        Some(("Resolving deltas", _)) => last,
        _ => first,
    };
    step(number, &format!("fetching {what}: {line}"))
}

/// git writes the files of a branch, tag or commit, and prints this line.
pub fn checking_out(name: &str, line: &str) -> String {
    step(8, format!("checking {name} out {line}").trim_end())
}
