//! The disk that the folders of all instances are on: how much room it has left, and how soon that may be used up.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use crate::simulation::process::DiskRoom;
use crate::simulation::process::disk_usage::SMALLEST;

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

/// The longest and the shortest time between two looks.
const LOOKS: (Duration, Duration) = (Duration::from_secs(1), Duration::from_millis(50));
/// Assumed speed of programs that write, in bytes per millisecond.
const FASTEST: u64 = (4 << 30) / 1000;
/// Time that an end has to show an effect before another simulation ends, unless the free room shrinks further.
const EFFECT: Duration = Duration::from_secs(5);
/// Another simulation ends when this part of the reserve has been used up since the last end: one in so many.
const PARTS: u64 = 4;

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
