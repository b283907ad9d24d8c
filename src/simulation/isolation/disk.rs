//! The disk of all instance directories: its free room, how soon that may be used up, and how much of it each
//! simulation takes: with its directory, and with unlinked files that its processes have open.

use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::simulation::process::disk_usage::{DiskRoom, DiskUsage, SMALLEST, room};
use crate::simulation::process::process_tree::{nameless_files, tree};

/// The disk, as of the last check.
pub struct Disk {
    folder: PathBuf,
    /// `diskReserve`, in MiB.
    reserve: u64,
    room: DiskRoom,
    /// Room that the disk has lost since the start, in bytes. Room that becomes free again is not subtracted, and what ended
    /// simulations had taken is added.
    pub lost: u64,
    /// Free room in bytes, and its time: when a simulation was last ended for the reserve, or the maximum since then.
    relieved: Option<(u64, Instant)>,
}

/// What one simulation takes, as of the last count. A simulation that exceeds its limit is ended.
pub struct DiskUse {
    /// The process that all its processes descend from.
    root: i32,
    /// The instance's directory.
    folder: PathBuf,
    /// What its project took at the start, and the maximum with `limits.disk`, in bytes.
    first: u64,
    allowed: u64,
    /// What it takes at least, in bytes.
    pub taken: u64,
    /// Whether its processes hide their open files.
    hides: bool,
    /// The room that the disk had lost at the last count.
    pub lost: u64,
    /// Time of the last count.
    pub counted: Instant,
    /// Sends why the simulation is ended, as text for its client. `None` from then on: it is not monitored any more.
    pub end: Option<oneshot::Sender<String>>,
}

/// The longest and the shortest time between two checks.
const LOOKS: (Duration, Duration) = (Duration::from_secs(1), Duration::from_millis(50));
/// Assumed speed of programs that write, in bytes per millisecond.
const FASTEST: u64 = (4 << 30) / 1000;
/// Time for an end to show an effect before another simulation is ended, unless the free room shrinks further.
const EFFECT: Duration = Duration::from_secs(5);
/// Another simulation is ended when 1/`PARTS` of the reserve has been used up since the last end.
const PARTS: u64 = 4;
/// Time between two counts for `limits.disk`.
const COUNT_AGAIN: Duration = Duration::from_secs(10);
/// A simulation that has grown less than this, in bytes, is not ended for the reserve: that would free nothing.
const LEAST_GROWTH: u64 = 1 << 20;

impl Disk {
    /// The disk with this directory, of which `reserve` MiB must stay free.
    pub fn new(folder: PathBuf, reserve: u64) -> Self {
        let room = DiskRoom::of(&folder).unwrap_or_default();
        Self {
            folder,
            reserve,
            room,
            lost: 0,
            relieved: None,
        }
    }

    /// Reads the free room; it stays as it was if the file system does not answer. Returns how much a simulation must
    /// have grown, in bytes, to be ended for the reserve now; `None` if none must be ended.
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
            // The directory of the ended simulation is being removed.
            Some((free, _)) if self.room.bytes > free => {
                self.relieve();
                None
            }
            Some((_, at)) if at.elapsed() >= EFFECT => Some(0),
            // The ended simulation may still write this much while it is killed: another must have written as much.
            Some((free, _)) => (free - self.room.bytes > part).then_some(part),
            None => Some(0),
        }
    }

    /// Notes that a simulation is ended for the reserve, or that none has grown.
    pub fn relieve(&mut self) {
        self.relieved = Some((self.room.bytes, Instant::now()));
    }

    /// Time until the next check: the shorter, the closer the free room is to the reserve.
    pub fn pause(&self) -> Duration {
        let above = self.room.bytes.saturating_sub(self.reserve << 20);
        Duration::from_millis(above / FASTEST).clamp(LOOKS.1, LOOKS.0)
    }
}

impl DiskUse {
    /// A simulation that has written nothing yet to its directory of `first` bytes; it may write `limit` MiB.
    pub fn new(root: i32, folder: PathBuf, first: u64, limit: u64) -> Self {
        let allowed = first.saturating_add(limit << 20);
        let counted = Instant::now();
        Self {
            root,
            folder,
            first,
            allowed,
            taken: first,
            hides: false,
            lost: 0,
            counted,
            end: None,
        }
    }

    /// Whether it may have exceeded its limit since the last count: the disk has lost as much room since then as it may
    /// still write. `lost` is the total until now.
    pub fn is_due(&self, lost: u64) -> bool {
        let left = self.allowed.saturating_sub(self.taken);
        lost.saturating_sub(self.lost) >= left && self.counted.elapsed() >= COUNT_AGAIN
    }

    /// Counts what it takes: its directory and then its unlinked files, each for at most `time`. Ends it, and returns
    /// true, if it exceeds its limit or a directory can't be read.
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
                    files
                        .iter()
                        .filter(|file| Some(file.dev()) == device)
                        .for_each(|file| size.add_nameless(file));
                }
                // The outermost program of a sandbox hides its files, and writes nothing.
                None => self.hides |= process != self.root,
            }
        }
    }

    /// Its growth in bytes, if its end would free room; the maximum if it hides its open files: it is ended first.
    pub fn growth(&self) -> Option<u64> {
        let grown = self.taken.saturating_sub(self.first);
        if self.hides {
            Some(u64::MAX)
        } else {
            Some(grown).filter(|grown| *grown >= LEAST_GROWTH)
        }
    }

    /// Ends it for the reserve, because it has grown most: by `growth` bytes.
    pub fn end_for_reserve(&mut self, growth: u64) {
        let what = match growth {
            u64::MAX => "hides which files it has open".to_owned(),
            bytes => format!("has written most there, {} MiB", bytes >> 20),
        };
        self.end(format!(
            "The disk of this simulation server is almost full (diskReserve), and the simulation {what}"
        ));
    }

    fn end(&mut self, why: String) {
        // The receiver may have been dropped.
        self.end.take().map(|end| end.send(why));
    }
}
