//! The display of a running rehearsal: the number of clients at each stage.

use std::cell::Cell;
use std::time::{Duration, Instant};

/// The stage of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stage {
    /// Waits for a slot.
    Waiting,
    /// Its world is being checked out, or Webots starts.
    Starting,
    /// Its simulation runs.
    Running,
}

/// Counts clients by stage, and prints the counts.
pub(crate) struct Board {
    start: Instant,
    counts: [Cell<u32>; 3],
    asked: Cell<u32>,
    refused: Cell<u32>,
    done: Cell<u32>,
}

/// Interval between two lines.
const BETWEEN_LINES: Duration = Duration::from_secs(5);

impl Board {
    /// An empty board whose clock starts now.
    pub(crate) fn new() -> Self {
        Self {
            start: Instant::now(),
            counts: Default::default(),
            asked: Cell::default(),
            refused: Cell::default(),
            done: Cell::default(),
        }
    }

    /// Seconds since the rehearsal began.
    pub(crate) fn now(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    /// Counts a client that starts its visit.
    pub(crate) fn came(&self) {
        self.asked.update(|count| count + 1);
    }

    /// Counts a client that has left; `got_one` tells whether its simulation ran, or it left on purpose.
    pub(crate) fn gone(&self, got_one: bool) {
        let counter = if got_one { &self.done } else { &self.refused };
        counter.update(|count| count + 1);
    }

    /// Counts a client at a stage until the guard is dropped.
    pub(crate) fn enter(&self, stage: Stage) -> AtStage<'_> {
        let count = match stage {
            Stage::Waiting => &self.counts[0],
            Stage::Starting => &self.counts[1],
            Stage::Running => &self.counts[2],
        };
        count.update(|count| count + 1);
        AtStage(count)
    }

    /// Prints the counts periodically until dropped.
    pub(crate) async fn show(&self) {
        loop {
            actix_rt::time::sleep(BETWEEN_LINES).await;
            eprintln!("{}", self.line());
        }
    }

    fn line(&self) -> String {
        let seconds = self.start.elapsed().as_secs();
        let [waiting, starting, running] = &self.counts;
        format!(
            "{:02}:{:02}  {} asked, {} wait, {} start, {} run, {} refused, {} gone",
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
