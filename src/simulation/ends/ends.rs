//! Records how simulations end. A thread of its own writes the files, so that a slow disk delays no actor.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use parking_lot::Mutex;
use prometheus::IntCounterVec;
use tokio::sync::oneshot;

use super::ended::Ended;
use super::{csv, kept_output};
use crate::shared::domain::Reason;
use crate::shared::http::Metrics;
use crate::shared::run::permanent;

/// Records how simulations end. Clones share the records.
#[derive(Debug, Clone)]
pub struct Ends {
    counter: IntCounterVec,
    latest: Arc<Mutex<VecDeque<Arc<Ended>>>>,
    writer: Sender<Job>,
}

/// A job of the thread.
enum Job {
    Write(Arc<Ended>),
    /// Answers once all earlier jobs are done.
    Flush(oneshot::Sender<()>),
}

/// Number of ends that the monitor lists.
const LISTED: usize = 20;
/// Longest interval between two removals of old files.
const BETWEEN_LOOKS: Duration = Duration::from_hours(1);
/// Timeout of pending writes when the server stops.
const FLUSH: Duration = Duration::from_secs(1);

impl Ends {
    /// Starts the thread. `logs` is the directory of the server's log, `level` the isolation level of
    /// simulations; the lines of ended simulations are kept for `months`.
    ///
    /// # Errors
    /// When a thread can't be started, or a counter `webots_simulation_ends_total` exists.
    pub fn start(logs: PathBuf, level: String, months: u32, metrics: &Metrics) -> std::io::Result<Self> {
        let counter = metrics
            .counter("webots_simulation_ends_total", "Simulations that have ended", "reason")
            .map_err(std::io::Error::other)?;
        for reason in Reason::FAILED_STARTS.iter().chain(Reason::ENDS) {
            counter.with_label_values(&[reason.code()]);
        }
        let (writer, jobs) = channel();
        permanent::thread("ends", move || write_all(&logs, &level, months, &jobs))?;
        Ok(Self {
            counter,
            latest: Arc::default(),
            writer,
        })
    }

    /// Records an end. That of a simulation that never had a client counts for nobody, and is listed only if it has failed.
    pub fn record(&self, ended: Ended) {
        if ended.client.is_some() {
            self.counter.with_label_values(&[ended.end.failure.reason.code()]).inc();
        }
        let ended = Arc::new(ended);
        if ended.client.is_some() || ended.is_abnormal() {
            let mut latest = self.latest.lock();
            if latest.len() == LISTED {
                latest.pop_back();
            }
            latest.push_front(Arc::clone(&ended));
        }
        // The thread runs until the last sender is dropped.
        self.writer.send(Job::Write(ended)).ok();
    }

    /// The last ends since the start of the server, the newest first.
    pub fn latest(&self) -> Vec<Arc<Ended>> {
        self.latest.lock().iter().cloned().collect()
    }

    /// Waits until all records are written, for a second at most.
    pub async fn flush(&self) {
        let (done, written) = oneshot::channel();
        self.writer.send(Job::Flush(done)).ok();
        if actix_rt::time::timeout(FLUSH, written).await.is_err() {
            log::warn!("not all ends of simulations are written: the disk of logDir is slow");
        }
    }
}

fn write_all(logs: &Path, level: &str, months: u32, jobs: &Receiver<Job>) {
    loop {
        // Once per batch of jobs.
        kept_output::prune(logs);
        csv::prune(logs, months);
        let first = match jobs.recv_timeout(BETWEEN_LOOKS) {
            Ok(job) => job,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        for job in std::iter::once(first).chain(jobs.try_iter()) {
            match job {
                Job::Write(ended) => write(logs, level, &ended),
                // The waiter may have been dropped.
                Job::Flush(done) => drop(done.send(())),
            }
        }
    }
}

fn write(logs: &Path, level: &str, ended: &Ended) {
    if ended.client.is_some()
        && let Err(error) = csv::append(logs, level, ended)
    {
        log::warn!("{}: its end is not in simulations.csv: {error}", ended.simulation.id);
    }
    if let Err(error) = kept_output::keep(logs, ended) {
        log::warn!("{}: its output is not kept: {error}", ended.simulation.id);
    }
}
