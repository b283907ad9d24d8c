//! What is shown while a rehearsal runs: how many clients are where.

use std::cell::{Cell, RefCell};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Where a client is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stage {
    /// Waits for a place.
    Waiting,
    /// Its world is being checked out, or Webots starts.
    Starting,
    /// Its simulation runs.
    Running,
}

/// Counts clients by stage, and shows that on the terminal.
pub(crate) struct Board {
    bar: ProgressBar,
    start: Instant,
    counts: [Cell<u32>; 3],
    asked: Cell<u32>,
    refused: Cell<u32>,
    done: Cell<u32>,
    factors: RefCell<(f64, u32)>,
}

/// Between two lines where there is no terminal.
const BETWEEN_LINES: Duration = Duration::from_secs(10);

impl Board {
    /// An empty board whose clock starts now.
    pub(crate) fn new() -> Self {
        let bar = ProgressBar::new_spinner();
        // A template that can't be read costs the looks alone.
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
            bar.set_style(style);
        }
        Self {
            bar,
            start: Instant::now(),
            counts: Default::default(),
            asked: Cell::default(),
            refused: Cell::default(),
            done: Cell::default(),
            factors: RefCell::default(),
        }
    }

    /// Seconds since the rehearsal began.
    pub(crate) fn now(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// A client has come.
    pub(crate) fn came(&self) {
        self.asked.update(|count| count + 1);
    }

    /// A client has gone; `got_one` tells whether its simulation ran, or it left on purpose.
    pub(crate) fn gone(&self, got_one: bool) {
        let counter = if got_one { &self.done } else { &self.refused };
        counter.update(|count| count + 1);
    }

    /// A client is at a stage as long as the guard lives.
    pub(crate) fn enter(&self, stage: Stage) -> AtStage<'_> {
        let count = match stage {
            Stage::Waiting => &self.counts[0],
            Stage::Starting => &self.counts[1],
            Stage::Running => &self.counts[2],
        };
        count.update(|count| count + 1);
        AtStage(count)
    }

    /// A simulation ran at this share of real time within the last second.
    pub(crate) fn paced(&self, factor: f64) {
        let mut factors = self.factors.borrow_mut();
        factors.0 += factor;
        factors.1 += 1;
    }

    /// Shows the counts each second until dropped.
    pub(crate) async fn show(&self) {
        let mut told = Instant::now();
        loop {
            actix_rt::time::sleep(Duration::from_secs(1)).await;
            let line = self.line();
            if std::io::stderr().is_terminal() {
                self.bar.set_message(line);
                self.bar.tick();
            } else if told.elapsed() >= BETWEEN_LINES {
                told = Instant::now();
                eprintln!("{line}");
            }
        }
    }

    /// Removes what was shown.
    pub(crate) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    fn line(&self) -> String {
        let seconds = self.start.elapsed().as_secs();
        let (sum, count) = self.factors.take();
        let pace = if count == 0 { String::new() } else { format!(", at {:.2} of real time", sum / f64::from(count)) };
        let [waiting, starting, running] = &self.counts;
        format!(
            "{:02}:{:02}  {} asked, {} wait, {} start, {} run{pace}, {} refused, {} gone",
            seconds / 60,
            seconds % 60,
            self.asked.get(),
            waiting.get(),
            starting.get(),
            running.get(),
            self.refused.get(),
            self.done.get()
        )
    }
}

/// Counts a client at its stage.
pub(crate) struct AtStage<'board>(&'board Cell<u32>);

impl Drop for AtStage<'_> {
    fn drop(&mut self) {
        self.0.update(|count| count.saturating_sub(1));
    }
}
