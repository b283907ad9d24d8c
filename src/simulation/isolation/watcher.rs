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
use crate::simulation::machine::{Tree, UsageMonitor};

/// Monitors simulations. Its thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub struct Watcher(Sender<(Watch, oneshot::Sender<String>)>);

/// What is monitored of one simulation.
pub struct Watch {
    /// The root of its process tree.
    pub root: i32,
    /// The directory of the instance.
    pub folder: PathBuf,
    /// What its project took at first, in bytes.
    pub first: u64,
    /// Limit of what it may write into that directory, in MiB.
    pub disk: u64,
    /// Limit of its processes and threads; `None` if the kernel enforces it.
    pub processes: Option<MostProcesses>,
    /// Receives its usage; `None` if its control group counts it.
    pub peak: Option<Arc<Peak>>,
}

/// A limit of processes that the kernel does not enforce.
#[derive(Debug, Clone, Copy)]
pub struct MostProcesses {
    /// The limit of the simulation's own processes and threads.
    pub limit: u64,
    /// Number of the tree's processes that run the simulation, and do not count.
    pub runners: u64,
}

/// A monitored simulation, and its state.
struct Watched {
    watch: Watch,
    /// Receives the message when it exceeds a limit.
    excess: oneshot::Sender<String>,
    disk: DiskUse,
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
    pub fn start(run: PathBuf, reserve: u64, usage: UsageMonitor) -> io::Result<Self> {
        let (watches, receiver) = channel();
        let mut table = Table { disk: Disk::new(run, reserve), usage, all: Vec::new() };
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

/// All monitored simulations.
struct Table {
    disk: Disk,
    usage: UsageMonitor,
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
                    Ok((watch, excess)) => {
                        let sizes = (watch.first, watch.disk);
                        let disk = DiskUse::new(watch.root, watch.folder.clone(), sizes, self.disk.lost());
                        self.all.push(Watched { watch, excess, disk });
                    }
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
            self.all.retain(|one| !one.excess.is_closed());
            self.disk.look();
            if self.disk.is_short() {
                let excess = self.find_grown_most();
                self.end(excess);
            }
            if Instant::now() >= tick {
                let begin = processor_time();
                self.look(begin);
                tick = Instant::now() + pause_after(processor_time().saturating_sub(begin));
            }
        }
    }

    /// Which simulation has grown most; none if none has grown: then another program fills the disk.
    fn find_grown_most(&mut self) -> Option<(i32, String)> {
        let until = Instant::now() + COUNTS_AT_RESERVE;
        let lost = self.disk.lost();
        // Also if none is found, so that the next try waits, too.
        self.disk.relieve();
        // The one that had grown most is counted first, then those whose count is oldest.
        self.all.sort_by_key(|one| one.disk.counted());
        let most = self.all.iter().enumerate().max_by_key(|(_, one)| one.disk.growth()).map(|(mount, _)| mount);
        most.inspect(|mount| self.all.swap(0, *mount));
        for one in &mut self.all {
            if Instant::now() >= until {
                break;
            }
            if let Some(why) = one.disk.count(lost, COUNT_AT_RESERVE) {
                return Some((one.watch.root, why));
            }
        }
        let grown = self.all.iter().filter_map(|one| Some((one.watch.root, one.disk.growth()?)));
        let (root, growth) = grown.max_by_key(|(_, growth)| *growth)?;
        Some((root, words(growth)))
    }

    /// One tick, which began at this processor time.
    fn look(&mut self, begin: Duration) {
        let mut excesses = self.count_folders(begin);
        excesses.extend(self.count_processes());
        self.end(excesses);
    }

    /// Sends these messages, and stops monitoring these simulations.
    fn end(&mut self, excesses: impl IntoIterator<Item = (i32, String)>) {
        for (root, why) in excesses {
            if let Some(mount) = self.all.iter().position(|one| one.watch.root == root) {
                // The receiver may be gone.
                self.all.swap_remove(mount).excess.send(why).ok();
            }
        }
    }

    fn count_folders(&mut self, begin: Duration) -> Vec<(i32, String)> {
        let (lost, time) = (self.disk.lost(), self.disk.pause().min(COUNT));
        let mut due: Vec<&mut Watched> = self.all.iter_mut().filter(|one| one.disk.is_due(lost)).collect();
        due.sort_by_key(|one| one.disk.counted());
        let mut excesses = Vec::new();
        for one in due {
            if processor_time().saturating_sub(begin) >= FOLDERS {
                break;
            }
            excesses.extend(one.disk.count(lost, time).map(|why| (one.watch.root, why)));
        }
        excesses
    }

    fn count_processes(&self) -> Vec<(i32, String)> {
        let is_counted =
            |watch: &Watch| watch.processes.is_some() || watch.peak.as_ref().is_some_and(|peak| peak.is_of_tree());
        let trees = self.all.iter().filter(|one| is_counted(&one.watch)).map(|one| Tree::of(one.watch.root));
        let usages = self.usage.read(&trees.collect::<Vec<_>>());
        for Watch { root, peak, .. } in self.all.iter().map(|one| &one.watch) {
            if let Some(peak) = peak {
                peak.look(usages.get(root));
            }
        }
        let counted = self.all.iter().filter_map(|one| Some((one.watch.root, one.watch.processes?)));
        let too_many = counted.filter(|(root, most)| {
            usages.get(root).is_some_and(|usage| usage.threads > most.limit.saturating_add(most.runners))
        });
        too_many
            .map(|(root, MostProcesses { limit, .. })| {
                let why = format!(
                    "The simulation has more than {limit} processes and threads, the limit of this server (limits.processes)"
                );
                (root, why)
            })
            .collect()
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
