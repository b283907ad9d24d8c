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

    /// Reads the free room; it stays as it was if the file system does not answer. Returns whether a simulation has to end for
    /// the reserve now, if one has grown.
    pub fn look(&mut self) -> bool {
        if let Ok(room) = DiskRoom::of(&self.folder) {
            let bytes = self.room.bytes.saturating_sub(room.bytes);
            let inodes = self.room.inodes.saturating_sub(room.inodes).saturating_mul(SMALLEST);
            self.lost = self.lost.saturating_add(bytes.max(inodes));
            self.room = room;
        }
        if self.room.shortage(self.reserve).is_none() {
            self.relieved = None;
            return false;
        }
        let is_more = self.relieved.is_some_and(|(free, _)| self.room.bytes > free);
        let has_to_end = self.relieved.is_none_or(|(free, at)| {
            free.saturating_sub(self.room.bytes) > (self.reserve << 20) / PARTS || at.elapsed() >= EFFECT
        });
        // Where there is more, the folder of the ended simulation is being removed.
        if is_more || has_to_end {
            self.relieved = Some((self.room.bytes, Instant::now()));
        }
        has_to_end && !is_more
    }

    /// Time until the next look: the shorter, the closer the free room is to the reserve.
    pub fn pause(&self) -> Duration {
        let above = self.room.bytes.saturating_sub(self.reserve << 20);
        Duration::from_millis(above / FASTEST).clamp(LOOKS.1, LOOKS.0)
    }
}
