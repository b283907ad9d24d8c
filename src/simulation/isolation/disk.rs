//! The disk that the folders of all instances are on: how much room it has left, how soon that may be used up, and how much
//! of it each simulation has taken: its folder, and files without a name that its processes have open.

use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::simulation::process::disk_usage::{DiskRoom, DiskUsage, SMALLEST, room};
use crate::simulation::process::process_tree::{nameless_files, tree};

/// The disk, as it was at the last look.
pub struct Disk {
    folder: PathBuf,
    /// `diskReserve`, in MiB.
    reserve: u64,
    room: DiskRoom,
    /// How much room it has lost since the start, in bytes: what becomes free again is not taken off.
    pub lost: u64,
    /// The free room when a simulation was last to end for the reserve, or the most since then, in bytes, and when that was.
    relieved: Option<(u64, Instant)>,
}

/// What one simulation has taken, as it was last counted. It ends when it exceeds its limit.
pub struct DiskUse {
    /// The process from which all of it descends.
    root: i32,
    /// The folder of the instance.
    folder: PathBuf,
    /// What its project took at first, and what it may take with `limits.disk`, in bytes.
    first: u64,
    allowed: u64,
    /// What it takes at least, in bytes.
    taken: u64,
    /// Whether its processes hide which files they have open.
    hides: bool,
    /// How much room the disk had lost when it was counted.
    pub lost: u64,
    /// When it was counted last.
    pub counted: Instant,
    /// Receives why it ends, as text for its client. It is gone then, and the simulation not watched any more.
    pub end: Option<oneshot::Sender<String>>,
}

/// The longest and the shortest time between two looks.
const LOOKS: (Duration, Duration) = (Duration::from_secs(1), Duration::from_millis(50));
/// Assumed speed of programs that write, in bytes per millisecond.
const FASTEST: u64 = (4 << 30) / 1000;
/// Time that an end has to show an effect before another simulation ends, unless the free room shrinks further.
const EFFECT: Duration = Duration::from_secs(5);
/// Another simulation ends when this part of the reserve has been used up since the last end: one in so many.
const PARTS: u64 = 4;
/// Time between two counts for `limits.disk`.
const COUNT_AGAIN: Duration = Duration::from_secs(10);
/// A simulation that has grown less, in bytes, does not end for the reserve: its end would free nothing.
const LEAST_GROWTH: u64 = 1 << 20;

impl Disk {
    /// The disk that a folder is on, of which so much is to be left free, in MiB.
    pub fn new(folder: PathBuf, reserve: u64) -> Self {
        let room = DiskRoom::of(&folder).unwrap_or_default();
        Self { folder, reserve, room, lost: 0, relieved: None }
    }

    /// Reads the free room; it stays as it was if the file system does not answer. Returns how much a simulation must have
    /// grown, in bytes, to end for the reserve now; `None` if none has to end.
    pub fn look(&mut self) -> Option<u64> {
        if let Ok(room) = DiskRoom::of(&self.folder) {
            let bytes = self.room.bytes.saturating_sub(room.bytes);
            let inodes = self.room.inodes.saturating_sub(room.inodes).saturating_mul(SMALLEST);
            self.lost = self.lost.saturating_add(bytes.max(inodes));
            self.room = room;
        }
        if self.room.shortage(self.reserve).is_none() {
            self.relieved = None;
            return None;
        }
        let part = (self.reserve << 20) / PARTS;
        match self.relieved {
            // The folder of the ended simulation is being removed.
            Some((free, _)) if self.room.bytes > free => {
                self.relieve();
                None
            }
            Some((_, at)) if at.elapsed() >= EFFECT => Some(0),
            // That may be what the ended one still writes while it is killed: another must have written as much.
            Some((free, _)) => (free - self.room.bytes > part).then_some(part),
            None => Some(0),
        }
    }

    /// Notes that a simulation ends for the reserve, or that none has grown.
    pub fn relieve(&mut self) {
        self.relieved = Some((self.room.bytes, Instant::now()));
    }

    /// Time until the next look: the shorter, the closer the free room is to the reserve.
    pub fn pause(&self) -> Duration {
        let above = self.room.bytes.saturating_sub(self.reserve << 20);
        Duration::from_millis(above / FASTEST).clamp(LOOKS.1, LOOKS.0)
    }
}

impl DiskUse {
    /// A simulation that has written nothing yet into its folder, which has `first` bytes; it may write `limit` MiB.
    pub fn new(root: i32, folder: PathBuf, first: u64, limit: u64) -> Self {
        let allowed = first.saturating_add(limit << 20);
        let counted = Instant::now();
        Self { root, folder, first, allowed, taken: first, hides: false, lost: 0, counted, end: None }
    }

    /// Whether it may have exceeded its limit since it was counted: the disk has lost as much as it may still write.
    /// `lost` is how much room the disk has lost until now.
    pub fn is_due(&self, lost: u64) -> bool {
        let left = self.allowed.saturating_sub(self.taken);
        lost.saturating_sub(self.lost) >= left && self.counted.elapsed() >= COUNT_AGAIN
    }

    /// Counts what it takes, within this time. Ends it, and returns true, if it exceeds its limit.
    pub fn count(&mut self, lost: u64, time: Duration) -> bool {
        let mut size = DiskUsage::new(room, self.allowed);
        size.until = Some(Instant::now() + time);
        let is_shown = size.add_folder(&self.folder);
        self.add_nameless(&mut size, Instant::now() + time);
        (self.taken, self.lost, self.counted) = (size.total, lost, Instant::now());
        let limit = (self.allowed - self.first) >> 20;
        if !is_shown {
            self.end("The simulation has folders that nobody can look into, too deep or closed".to_owned());
        } else if self.taken > self.allowed {
            self.end(format!(
                "The simulation has written more than {limit} MiB, the limit of this server (limits.disk)"
            ));
        }
        self.end.is_none()
    }

    fn add_nameless(&mut self, size: &mut DiskUsage, until: Instant) {
        let device = self.folder.metadata().map(|about| about.dev()).ok();
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

    /// How much it has grown, in bytes, if its end would free room. One that hides its open files comes before all others.
    pub fn growth(&self) -> Option<u64> {
        let grown = self.taken.saturating_sub(self.first);
        if self.hides { Some(u64::MAX) } else { Some(grown).filter(|grown| *grown >= LEAST_GROWTH) }
    }

    /// Ends it for the reserve: it has grown most, by so many bytes.
    pub fn end_for_reserve(&mut self, growth: u64) {
        let what = match growth {
            u64::MAX => "hides which files it has open".to_owned(),
            bytes => format!("has written most there, {} MiB", bytes >> 20),
        };
        self.end(format!("The disk of this simulation server is almost full (diskReserve), and the simulation {what}"));
    }

    fn end(&mut self, why: String) {
        // The receiver may be gone.
        self.end.take().map(|end| end.send(why));
    }
}
