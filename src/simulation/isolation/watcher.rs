//! Watches over what simulations take that the kernel does not limit: room on the disk, and on some machines processes.
//! One thread looks for all of them.
//!
//! The free room of the disk is looked at each second, and more often as it comes close to the reserve (`diskReserve`). At the
//! reserve the simulation ends that has grown most, then the next.
//!
//! All else is done in ticks that take 1 % of one core at most: as they take longer, the pause between them grows. One pass
//! over `/proc` serves all simulations. Folders, which have to be counted one by one, are counted only when the disk has lost
//! as much room as the simulation may still write, and every ten seconds at most.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_gettime};
use tokio::sync::oneshot;

use super::disk::Disk;
use super::disk_use::{DiskUse, words};
use super::peak::Peak;
use crate::simulation::machine::usages;

/// Monitors simulations. Its thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub struct Watcher(Sender<(Watch, oneshot::Sender<String>)>);

/// What is monitored of one simulation.
pub struct Watch {
    /// What it has taken of the disk.
    pub disk: DiskUse,
    /// Limit of its own processes and threads; `None` if the kernel enforces it.
    pub processes: Option<u64>,
    /// Number of the tree's processes that run the simulation, and do not count.
    pub runners: u64,
    /// Receives its usage; `None` if its control group counts it.
    pub peak: Option<Arc<Peak>>,
}

/// A monitored simulation.
struct Watched {
    watch: Watch,
    /// Receives the message when it exceeds a limit, and is gone then.
    excess: Option<oneshot::Sender<String>>,
}

/// The shortest time between two ticks.
const SHORTEST: Duration = Duration::from_secs(1);
/// The longest time between two ticks: a simulation that makes ticks slow gains no more than this.
const LONGEST: Duration = Duration::from_secs(10);
/// The pause after a tick, as a multiple of its CPU time: 1 % of one core.
const PAUSE: u32 = 99;
/// Limit of processor time for folders in a tick. The remaining ones are counted in the next tick.
const FOLDERS: Duration = Duration::from_millis(100);
/// Time limits: of counting a folder for `limits.disk`; of counting one when the reserve is reached, and of counting all
/// folders then.
const COUNT: Duration = Duration::from_secs(1);
const COUNT_AT_RESERVE: Duration = Duration::from_millis(100);
const COUNTS_AT_RESERVE: Duration = Duration::from_millis(300);

impl Watcher {
    /// Starts the thread. `run` is the directory with the directories of all instances, `reserve` is `diskReserve`.
    ///
    /// # Errors
    /// When the system can't start a thread.
    pub fn start(run: PathBuf, reserve: u64) -> io::Result<Self> {
        let (watches, receiver) = channel();
        let mut table = Table { disk: Disk::new(run, reserve), all: Vec::new() };
        std::thread::Builder::new().name("watcher".to_owned()).spawn(move || table.run(&receiver))?;
        Ok(Self(watches))
    }

    /// Waits until a simulation exceeds a limit. Returns the message for its client. Dropping the future ends the
    /// monitoring.
    pub async fn until_too_much(&self, watch: Watch) -> String {
        let (excess, told) = oneshot::channel();
        // The thread lives as long as this.
        self.0.send((watch, excess)).ok();
        match told.await {
            Ok(why) => why,
            Err(_) => std::future::pending().await,
        }
    }
}

impl Watched {
    /// Sends this message, and ends the monitoring.
    fn end(&mut self, why: String) {
        // The receiver may be gone.
        self.excess.take().map(|excess| excess.send(why));
    }
}

/// All monitored simulations.
struct Table {
    disk: Disk,
    all: Vec<Watched>,
}

impl Table {
    fn run(&mut self, watches: &Receiver<(Watch, oneshot::Sender<String>)>) {
        let mut tick = Instant::now() + SHORTEST;
        loop {
            let next = tick.min(Instant::now() + self.disk.pause());
            loop {
                let left = next.saturating_duration_since(Instant::now());
                match if self.all.is_empty() { watches.recv().map_err(Into::into) } else { watches.recv_timeout(left) }
                {
                    Ok((mut watch, excess)) => {
                        watch.disk.lost = self.disk.lost;
                        self.all.push(Watched { watch, excess: Some(excess) });
                    }
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
            self.all.retain(|one| one.excess.as_ref().is_some_and(|excess| !excess.is_closed()));
            if let Some(least) = self.disk.look()
                && (self.end_grown_most(least) || least == 0)
            {
                self.disk.relieve();
            }
            if Instant::now() >= tick {
                let begin = processor_time();
                self.count_folders(begin);
                self.count_processes();
                tick = Instant::now() + pause_after(processor_time().saturating_sub(begin));
            }
        }
    }

    /// Ends the simulation that has grown most, and by so many bytes at least. Returns false if none has: then another program
    /// fills the disk.
    fn end_grown_most(&mut self, least: u64) -> bool {
        let (until, lost) = (Instant::now() + COUNTS_AT_RESERVE, self.disk.lost);
        // The one that had grown most is counted first, then those whose count is oldest.
        self.all.sort_by_key(|one| one.watch.disk.counted);
        let most = self.all.iter().enumerate().max_by_key(|(_, one)| one.watch.disk.growth()).map(|(index, _)| index);
        most.inspect(|index| self.all.swap(0, *index));
        for one in &mut self.all {
            if Instant::now() >= until {
                break;
            }
            if let Some(why) = one.watch.disk.count(lost, COUNT_AT_RESERVE) {
                one.end(why);
                return true;
            }
        }
        let grown = self.all.iter_mut().filter_map(|one| Some((one.watch.disk.growth()?, one)));
        match grown.max_by_key(|(growth, _)| *growth) {
            Some((growth, one)) if growth >= least => {
                one.end(words(growth));
                true
            }
            _ => false,
        }
    }

    /// Counts what simulations have written, in a tick that began at this processor time.
    fn count_folders(&mut self, begin: Duration) {
        let (lost, time) = (self.disk.lost, self.disk.pause().min(COUNT));
        let mut due: Vec<&mut Watched> = self.all.iter_mut().filter(|one| one.watch.disk.is_due(lost)).collect();
        due.sort_by_key(|one| one.watch.disk.counted);
        for one in due {
            if processor_time().saturating_sub(begin) >= FOLDERS {
                break;
            }
            if let Some(why) = one.watch.disk.count(lost, time) {
                one.end(why);
            }
        }
    }

    fn count_processes(&mut self) {
        let is_counted =
            |watch: &Watch| watch.processes.is_some() || watch.peak.as_ref().is_some_and(|peak| peak.is_of_tree());
        let trees = self.all.iter().map(|one| &one.watch).filter(|watch| is_counted(watch));
        let usages = usages(&trees.map(|watch| watch.disk.root).collect::<Vec<_>>());
        for one in &mut self.all {
            let usage = usages.get(&one.watch.disk.root);
            one.watch.peak.iter().for_each(|peak| peak.look(usage));
            if let (Some(limit), Some(usage)) = (one.watch.processes, usage)
                && usage.threads > limit.saturating_add(one.watch.runners)
            {
                one.end(format!(
                    "The simulation has more than {limit} processes and threads, the limit of this server (limits.processes)"
                ));
            }
        }
    }
}

/// CPU time of this thread. Time that a tick waits for a busy machine or its disk does not count.
fn processor_time() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map(Duration::from).unwrap_or_default()
}

/// The pause after a tick with this CPU time.
fn pause_after(tick: Duration) -> Duration {
    (tick * PAUSE).clamp(SHORTEST, LONGEST)
}
