//! The display of a running rehearsal: the number of clients at each stage.

use std::cell::{Cell, RefCell};
use std::io::{IsTerminal, Write};
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

/// Counts clients by stage, and shows the counts on the terminal.
pub(crate) struct Board {
    start: Instant,
    counts: [Cell<u32>; 3],
    asked: Cell<u32>,
    refused: Cell<u32>,
    done: Cell<u32>,
    factors: RefCell<(f64, u32)>,
}

/// Interval between two lines if there is no terminal.
const BETWEEN_LINES: Duration = Duration::from_secs(10);

impl Board {
    /// An empty board whose clock starts now.
    pub(crate) fn new() -> Self {
        Self {
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

    /// Records that a simulation ran at this share of real time within the last second.
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
                rewrite_line(&line);
            } else if told.elapsed() >= BETWEEN_LINES {
                told = Instant::now();
                eprintln!("{line}");
            }
        }
    }

    /// Clears the shown line.
    pub(crate) fn clear() {
        if std::io::stderr().is_terminal() {
            rewrite_line("");
        }
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

/// Overwrites the terminal's last line with a text, cut at the terminal's width.
fn rewrite_line(text: &str) {
    // To the begin of the line, without wrapping; the old text is erased.
    let written = write!(std::io::stderr(), "\r\x1b[?7l\x1b[2K{text}\x1b[?7h");
    // The reader may have closed the pipe.
    written.and_then(|()| std::io::stderr().flush()).ok();
}

/// Counts a client at its stage.
pub(crate) struct AtStage<'board>(&'board Cell<u32>);

impl Drop for AtStage<'_> {
    fn drop(&mut self) {
        self.0.update(|count| count.saturating_sub(1));
    }
}
