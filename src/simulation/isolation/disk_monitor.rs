//! Monitors what simulations write to the disk, because the kernel does not limit it. One thread monitors all of them.
//!
//! The free room of the disk is read each second, and more often as it comes close to the reserve (`diskReserve`). At
//! the reserve, the simulation that has grown most is ended, then the next.
//!
//! For `limits.disk`, the directory of each simulation has to be counted. It is counted only when the disk has lost as
//! much room as the simulation may still write, and at most every ten seconds. Counting takes about 1 % of one core:
//! the longer a tick takes, the longer the pause after it.

use std::io;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_gettime};
use tokio::sync::oneshot;

use super::disk::{Disk, DiskUse};
use crate::shared::run::permanent;

/// Monitors simulations. Its thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub struct DiskMonitor(Sender<DiskUse>);

/// The shortest time between two ticks.
const SHORTEST: Duration = Duration::from_secs(1);
/// The longest time between two ticks: a simulation that makes ticks slow can't delay them further.
const LONGEST: Duration = Duration::from_secs(10);
/// The pause after a tick, as a multiple of its CPU time: 1 % of one core.
const PAUSE: u32 = 99;
/// Limit of CPU time for counting directories in a tick. The remaining ones are counted in the next tick.
const FOLDERS: Duration = Duration::from_millis(100);
/// Time limits: of counting a directory for `limits.disk`; of counting one when the reserve is reached, and of counting
/// all directories then.
const COUNT: Duration = Duration::from_secs(1);
const COUNT_AT_RESERVE: Duration = Duration::from_millis(100);
const COUNTS_AT_RESERVE: Duration = Duration::from_millis(300);

impl DiskMonitor {
    /// Starts the thread. `run` is the directory with the directories of all instances, `reserve` is `diskReserve`.
    ///
    /// # Errors
    /// When the system can't start a thread.
    pub fn start(run: PathBuf, reserve: u64) -> io::Result<Self> {
        let (watches, receiver) = channel();
        let mut table = Table {
            disk: Disk::new(run, reserve),
            all: Vec::new(),
        };
        permanent::thread("disk-monitor", move || table.run(&receiver))?;
        Ok(Self(watches))
    }

    /// Waits until a simulation exceeds a limit. Returns the message for its client. Dropping the future ends the
    /// monitoring.
    pub async fn until_too_much(self, mut simulation: DiskUse) -> String {
        let (end, told) = oneshot::channel();
        simulation.end = Some(end);
        // The thread runs as long as this sender exists.
        self.0.send(simulation).ok();
        match told.await {
            Ok(why) => why,
            Err(_) => std::future::pending().await,
        }
    }
}

/// All monitored simulations.
struct Table {
    disk: Disk,
    all: Vec<DiskUse>,
}

impl Table {
    fn run(&mut self, watches: &Receiver<DiskUse>) {
        let mut tick = Instant::now() + SHORTEST;
        loop {
            let next = tick.min(Instant::now() + self.disk.pause());
            let left = next.saturating_duration_since(Instant::now());
            let come = if self.all.is_empty() {
                watches.recv().map_err(Into::into)
            } else {
                watches.recv_timeout(left)
            };
            match come {
                Ok(mut usage) => {
                    usage.lost = self.disk.lost;
                    self.all.push(usage);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            // Its directory is removed. What others write meanwhile must not hide behind the room that this frees.
            for gone in self
                .all
                .extract_if(.., |usage| usage.end.as_ref().is_none_or(oneshot::Sender::is_closed))
            {
                self.disk.lost += gone.taken;
            }
            if let Some(least) = self.disk.look()
                && (self.end_grown_most(least) || least == 0)
            {
                self.disk.relieve();
            }
            if Instant::now() >= tick {
                let begin = processor_time();
                self.count_folders(begin);
                let pause = processor_time().saturating_sub(begin) * PAUSE;
                tick = Instant::now() + pause.clamp(SHORTEST, LONGEST);
            }
        }
    }

    /// Ends the simulation that has grown most, if by at least `least` bytes. Returns false if none has: then another
    /// program fills the disk.
    fn end_grown_most(&mut self, least: u64) -> bool {
        let until = Instant::now() + COUNTS_AT_RESERVE;
        let lost = self.disk.lost;
        // The oldest counts are renewed first.
        self.all.sort_by_key(|usage| usage.counted);
        for usage in &mut self.all {
            if Instant::now() >= until {
                break;
            }
            if usage.count(lost, COUNT_AT_RESERVE) {
                return true;
            }
        }
        let grown = self.all.iter_mut().filter_map(|usage| Some((usage.growth()?, usage)));
        match grown.max_by_key(|(growth, _)| *growth) {
            Some((growth, usage)) if growth >= least => {
                usage.end_for_reserve(growth);
                true
            }
            _ => false,
        }
    }

    /// Counts what simulations have written, in a tick that began at this CPU time of the thread.
    fn count_folders(&mut self, begin: Duration) {
        let lost = self.disk.lost;
        let time = self.disk.pause().min(COUNT);
        let mut due: Vec<&mut DiskUse> = self.all.iter_mut().filter(|usage| usage.is_due(lost)).collect();
        due.sort_by_key(|usage| usage.counted);
        for usage in due {
            if processor_time().saturating_sub(begin) >= FOLDERS {
                break;
            }
            usage.count(lost, time);
        }
    }
}

/// CPU time of this thread. Time that a tick waits for a busy machine or its disk does not count.
fn processor_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID)
        .map(Duration::from)
        .unwrap_or_default()
}
