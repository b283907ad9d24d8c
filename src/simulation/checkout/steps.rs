//! The steps of a checkout, as text for its client. Pure.
//!
//! Webots' page moves its progress bar by texts such as `Step 3/9 : ...`, in which each number has one digit, and by
//! one that ends in `done`. Most of a start is the fetch, so it takes several steps, by the percentage that git
//! reports.

/// Number of steps.
const STEPS: u64 = 9;
/// The first and the last step of a fetch; the steps between them follow the received objects.
const FETCH: (u64, u64) = (2, 7);

/// The last text.
pub const DONE: &str = "checkout done";

fn step(number: u64, what: &str) -> String {
    format!("Step {number}/{STEPS} : {what}")
}

/// The remote is asked what it has.
pub fn looking_for(repository: &str) -> String {
    step(1, &format!("looking for {repository}"))
}

/// git fetches, and says this.
pub fn fetching(what: &str, line: &str) -> String {
    let (first, last) = FETCH;
    let number = match line.split_once(':') {
        Some(("Receiving objects", rest)) => first + (last - first) * percent(rest) / 100,
        Some(("Resolving deltas", _)) => last,
        _ => first,
    };
    step(number, &format!("fetching {what}: {line}"))
}

/// git writes the files of a branch, tag or commit, and says this.
pub fn checking_out(name: &str, line: Option<&str>) -> String {
    let line = line.map_or_else(String::new, |line| format!(": {line}"));
    step(8, &format!("checking {name} out{line}"))
}

fn percent(text: &str) -> u64 {
    let percent = text.split_once('%').and_then(|(percent, _)| percent.trim().parse().ok());
    percent.unwrap_or(0).min(100)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How Webots' page parses a text: one digit at each of these positions.
    fn bar(text: &str) -> Option<f64> {
        let digit = |at| text.chars().nth(at).and_then(|letter| letter.to_digit(10)).map(f64::from);
        text.starts_with("Step ").then_some(())?;
        Some(20.0 + 65.0 * digit(5)? / (digit(7)? + 1.0))
    }

    #[test]
    fn the_bar_of_webots_page_moves_with_a_fetch_and_never_back() {
        let git = [
            "waiting for another fetch",
            "Counting objects: 100% (7/7), done.",
            "Compressing objects:  50% (1/2)",
            "Receiving objects:   0% (0/20)",
            "Receiving objects:  35% (7/20), 1.20 MiB | 300.00 KiB/s",
            "Receiving objects: 100% (20/20), done.",
            "Resolving deltas:  10% (1/10)",
        ];
        let fetch = git.map(|said| fetching("https://github.com/lab/arm", said));
        let all = [looking_for("https://github.com/lab/arm")].into_iter().chain(fetch);
        let all: Vec<_> = all.chain([checking_out("main", None), checking_out("main", Some("50%"))]).collect();
        let bars: Vec<_> = all.iter().map(|text| bar(text).unwrap()).collect();
        assert!(bars.is_sorted(), "{all:#?}");
        assert_eq!(
            all[5],
            "Step 3/9 : fetching https://github.com/lab/arm: Receiving objects:  35% (7/20), 1.20 MiB | 300.00 KiB/s"
        );
        assert!(bars[3] < bars[5] && bars[5] < bars[6], "{bars:?}");
    }
}
