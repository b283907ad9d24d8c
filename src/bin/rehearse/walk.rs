//! The steps of an acceptance run, and how they are told.

use std::time::{Duration, Instant};

use crate::arguments::Arguments;

/// The walk through the steps.
pub(crate) struct Walk {
    began: Instant,
    last: Instant,
    steps: Vec<Step>,
}

/// One step, and what came of it.
struct Step {
    name: &'static str,
    /// When it ended, since the beginning.
    at: Duration,
    took: Duration,
    expected: &'static str,
    came: String,
    agrees: bool,
}

impl Walk {
    /// Begins now.
    pub(crate) fn new() -> Self {
        let now = Instant::now();
        Self { began: now, last: now, steps: Vec::new() }
    }

    /// Notes what came at a step, and begins the next.
    pub(crate) fn note(&mut self, name: &'static str, expected: &'static str, came: String, agrees: bool) {
        let took = self.last.elapsed();
        self.last = Instant::now();
        self.steps.push(Step { name, at: self.began.elapsed(), took, expected, came, agrees });
    }

    /// Whether all of it was as expected.
    pub(crate) fn agrees(&self) -> bool {
        self.steps.iter().all(|step| step.agrees)
    }

    /// All steps as a table in Markdown, and which of them differ.
    pub(crate) fn text(&self, arguments: &Arguments) -> String {
        let mut lines = vec![
            format!(
                "`rehearse {} --explain`, {} {}",
                arguments.fleet,
                env!("CARGO_PKG_NAME"),
                env!("CARGO_PKG_VERSION")
            ),
            format!("World: {}", arguments.world),
            String::new(),
            "| step | at | took | expected | came | |".to_owned(),
            "|---|---|---|---|---|---|".to_owned(),
        ];
        lines.extend(self.steps.iter().map(|step| {
            let (at, took) = (step.at.as_secs_f64(), step.took.as_secs_f64());
            let verdict = if step.agrees { "ok" } else { "**differs**" };
            let came = step.came.replace('|', "\\|");
            format!("| {} | {at:.2} s | {took:.2} s | {} | {came} | {verdict} |", step.name, step.expected)
        }));
        let differing: Vec<&str> = self.steps.iter().filter(|step| !step.agrees).map(|step| step.name).collect();
        let verdict = match differing.as_slice() {
            [] => "All steps are as expected.".to_owned(),
            names => format!("{} of {} steps differ: {}.", names.len(), self.steps.len(), names.join(", ")),
        };
        lines.extend([String::new(), verdict]);
        lines.join("\n")
    }
}
