//! How much room a disk has left, in bytes and in inodes.

use std::path::Path;

use nix::sys::statvfs::statvfs;

/// The room that a disk has left for ordinary users.
#[derive(Debug, Clone, Copy, Default)]
pub struct DiskRoom {
    /// In bytes.
    pub bytes: u64,
    /// Free inodes. Some file systems make inodes as they need them, and report none.
    pub inodes: u64,
    /// All inodes.
    all_inodes: u64,
}

/// The least share of the disk's inodes that must be free: one in so many.
const FREE_INODES: u64 = 50;

impl DiskRoom {
    /// The room of the disk that a folder is on.
    ///
    /// # Errors
    /// When the file system does not say.
    pub fn of(folder: &Path) -> std::io::Result<Self> {
        let disk = statvfs(folder)?;
        let bytes = disk.blocks_available().saturating_mul(disk.fragment_size());
        Ok(Self { bytes, inodes: disk.files_available(), all_inodes: disk.files() })
    }

    /// What is less than the reserve (in MiB), in words. Without the numbers that change with each call.
    pub fn shortage(&self, reserve: u64) -> Option<String> {
        if self.bytes >> 20 < reserve {
            return Some(format!("{reserve} MiB are left (diskReserve)"));
        }
        (self.inodes < self.all_inodes / FREE_INODES).then(|| "2 % of its inodes are left".to_owned())
    }
}
