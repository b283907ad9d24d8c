//! How much of the disk one simulation has taken: its folder, and files without a name that its processes have open.

use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crate::simulation::process::disk_usage::{DiskUsage, room};
use crate::simulation::process::process_tree::{nameless_files, tree};

/// What one simulation has taken, as it was last counted.
pub struct DiskUse {
    /// The process from which all of it descends.
    pub root: i32,
    /// The folder of the instance.
    folder: PathBuf,
    /// How much it may write, in MiB.
    limit: u64,
    /// What its project took at first, in bytes.
    first: u64,
    /// What it takes at least, in bytes.
    taken: u64,
    /// Whether its processes hide which files they have open.
    hides: bool,
    /// How much room the disk had lost when it was counted.
    pub lost: u64,
    /// When it was counted last.
    pub counted: Instant,
}

/// Time between two counts for `limits.disk`.
const COUNT_AGAIN: Duration = Duration::from_secs(10);
/// A simulation that has grown less, in bytes, does not end for the reserve: its end would free nothing.
const LEAST_GROWTH: u64 = 1 << 20;

impl DiskUse {
    /// A simulation that has written nothing yet into its folder, which has `first` bytes; it may write `limit` MiB.
    pub fn new(root: i32, folder: PathBuf, first: u64, limit: u64) -> Self {
        Self { root, folder, limit, first, taken: first, hides: false, lost: 0, counted: Instant::now() }
    }

    /// Whether it may have exceeded its limit since it was counted: the disk has lost as much as it may still write.
    /// `lost` is how much room the disk has lost until now.
    pub fn is_due(&self, lost: u64) -> bool {
        let left = self.allowed().saturating_sub(self.taken);
        lost.saturating_sub(self.lost) >= left && self.counted.elapsed() >= COUNT_AGAIN
    }

    /// Counts what it takes, within this time. Returns a message for its client if it exceeds its limit.
    pub fn count(&mut self, lost: u64, time: Duration) -> Option<String> {
        let mut size = DiskUsage::new(room, self.allowed()).within(time);
        let is_shown = size.add_folder(&self.folder);
        self.add_nameless(&mut size, time);
        (self.taken, self.lost, self.counted) = (size.total(), lost, Instant::now());
        if !is_shown {
            return Some("The simulation has folders that nobody can look into, too deep or closed".to_owned());
        }
        let limit = self.limit;
        (self.taken > self.allowed()).then(|| {
            format!("The simulation has written more than {limit} MiB, the limit of this server (limits.disk)")
        })
    }

    fn add_nameless(&mut self, size: &mut DiskUsage, time: Duration) {
        let (until, device) = (Instant::now() + time, self.folder.metadata().map(|about| about.dev()).ok());
        self.hides = false;
        for process in tree(self.root) {
            if Instant::now() >= until {
                return;
            }
            match nameless_files(process) {
                Some(files) => {
                    files.iter().filter(|file| Some(file.dev()) == device).for_each(|file| size.add_nameless(file));
                }
                // The programs that run a sandbox hide, and write nothing.
                None => self.hides |= process != self.root,
            }
        }
    }

    /// What it may take, in bytes: the limit besides what it took at first.
    fn allowed(&self) -> u64 {
        self.first.saturating_add(self.limit << 20)
    }

    /// How much it has grown, in bytes, if its end would free room. One that hides its open files comes before all others.
    pub fn growth(&self) -> Option<u64> {
        let grown = self.taken.saturating_sub(self.first);
        if self.hides { Some(u64::MAX) } else { Some(grown).filter(|grown| *grown >= LEAST_GROWTH) }
    }
}

/// Why a simulation ends for the reserve, as text for its client.
pub fn words(growth: u64) -> String {
    let what = match growth {
        u64::MAX => "hides which files it has open".to_owned(),
        bytes => format!("has written most there, {} MiB", bytes >> 20),
    };
    format!("The disk of this simulation server is almost full (diskReserve), and the simulation {what}")
}
