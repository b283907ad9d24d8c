//! The steps of an acceptance run, printed one by one.

use std::io::Write;
use std::time::Instant;

use crate::arguments::Arguments;
use crate::words::line;

/// The walk through the steps.
pub(crate) struct StepLog {
    began: Instant,
    last: Instant,
    /// Number of steps so far.
    steps: usize,
    /// The steps that are not as expected.
    differing: Vec<&'static str>,
}

impl StepLog {
    /// Begins now, and prints the heading of the table.
    pub(crate) fn begin(arguments: &Arguments) -> Self {
        let name = env!("CARGO_PKG_NAME");
        let version = env!("CARGO_PKG_VERSION");
        print(&format!("`rehearse {} --explain`, {name} {version}", arguments.fleet));
        print(&format!("World: {}\n", arguments.world));
        print("| step | at | took | expected | came | |\n|---|---|---|---|---|---|");
        let now = Instant::now();
        Self {
            began: now,
            last: now,
            steps: 0,
            differing: Vec::new(),
        }
    }

    /// Prints the result of a step, and begins the next.
    pub(crate) fn note(&mut self, name: &'static str, expected: &'static str, came: &str, agrees: bool) {
        let at = self.began.elapsed().as_secs_f64();
        let took = self.last.elapsed().as_secs_f64();
        self.last = Instant::now();
        self.steps += 1;
        if !agrees {
            self.differing.push(name);
        }
        let verdict = if agrees { "ok" } else { "**differs**" };
        let came = line(came).replace('|', "\\|");
        print(&format!(
            "| {name} | {at:.2} s | {took:.2} s | {expected} | {came} | {verdict} |"
        ));
    }

    /// Prints which steps differ. Returns whether none does.
    pub(crate) fn end(self) -> bool {
        let verdict = match self.differing.as_slice() {
            [] => "All steps are as expected.".to_owned(),
            names => format!("{} of {} steps differ: {}.", names.len(), self.steps, names.join(", ")),
        };
        print(&format!("\n{verdict}"));
        self.differing.is_empty()
    }
}

/// Prints a line. The reader may have closed the pipe.
fn print(line: &str) {
    let mut out = std::io::stdout();
    writeln!(out, "{line}").and_then(|()| out.flush()).ok();
}
