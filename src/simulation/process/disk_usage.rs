//! The free room of a disk, and the room that the files below a directory take, even while programs change them.

use std::collections::HashSet;
use std::ffi::OsString;
use std::fs::Metadata;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::rc::Rc;
use std::time::Instant;

use nix::sys::statvfs::statvfs;

/// The free room of a disk for ordinary users.
#[derive(Debug, Clone, Copy, Default)]
pub struct DiskRoom {
    /// In bytes.
    pub bytes: u64,
    /// Free inodes. Some file systems make inodes as they need them, and report none.
    pub inodes: u64,
    /// All inodes.
    all_inodes: u64,
}

/// Adds up files.
pub struct DiskUsage {
    measure: fn(&Metadata) -> u64,
    /// Counting stops above this many bytes.
    enough: u64,
    /// When to stop counting.
    pub until: Option<Instant>,
    /// The sum so far.
    pub total: u64,
    /// Device and inode of the unlinked files.
    nameless: HashSet<(u64, u64)>,
}

/// Least disk usage of a file or directory, in bytes.
pub const SMALLEST: u64 = 4096;
/// At least 1/`FREE_INODES` of the disk's inodes must be free.
const FREE_INODES: u64 = 50;

/// The disk space of a file or directory, without holes.
pub fn room(about: &Metadata) -> u64 {
    (about.blocks() * 512).max(SMALLEST)
}

/// The length of a file; 0 for a directory.
pub fn length(about: &Metadata) -> u64 {
    if about.is_dir() { 0 } else { about.len() }
}

impl DiskRoom {
    /// The free room of the disk with this directory.
    ///
    /// # Errors
    /// When the file system does not report it.
    pub fn of(folder: &Path) -> std::io::Result<Self> {
        let disk = statvfs(folder)?;
        let bytes = disk.blocks_available().saturating_mul(disk.fragment_size());
        Ok(Self {
            bytes,
            inodes: disk.files_available(),
            all_inodes: disk.files(),
        })
    }

    /// What is below the reserve (in MiB), as text without numbers that change with each call; `None` if nothing is.
    pub fn shortage(&self, reserve: u64) -> Option<String> {
        if self.bytes >> 20 < reserve {
            return Some(format!("{reserve} MiB are left (diskReserve)"));
        }
        (self.inodes < self.all_inodes / FREE_INODES).then(|| "2 % of its inodes are left".to_owned())
    }
}

impl DiskUsage {
    /// Adds up files by this measure; stops above `enough`.
    pub fn new(measure: fn(&Metadata) -> u64, enough: u64) -> Self {
        Self {
            measure,
            enough,
            until: None,
            total: 0,
            nameless: HashSet::new(),
        }
    }

    /// Adds everything below a directory until the time is up. Symlinks are not followed. Returns false if a directory
    /// can't be read: it is closed to this server, or nested too deep for a path.
    pub fn add_folder(&mut self, folder: &Path) -> bool {
        // The directories that are left: the path of the one above, and their name. At any moment these are the siblings of
        // one path, so their paths, which may be long, are only as many as that path is deep.
        let mut open: Vec<(Rc<Path>, OsString)> = vec![(Rc::from(folder), OsString::new())];
        let mut is_shown = true;
        while let Some((above, name)) = open.pop() {
            if self.until.is_some_and(|until| Instant::now() >= until) {
                return is_shown;
            }
            let folder: Rc<Path> = if name.is_empty() {
                above
            } else {
                above.join(name).into()
            };
            let entries = match std::fs::read_dir(&folder) {
                Ok(entries) => entries,
                Err(error) => {
                    // It may have been removed during the walk.
                    is_shown &= matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory);
                    continue;
                }
            };
            for entry in entries.flatten() {
                let Ok(about) = entry.metadata() else { continue };
                self.add(&about);
                if self.total > self.enough {
                    return true;
                }
                if self.until.is_some_and(|until| Instant::now() >= until) {
                    return is_shown;
                }
                if about.is_dir() {
                    open.push((Rc::clone(&folder), entry.file_name()));
                }
            }
        }
        is_shown
    }

    /// Adds an unlinked file that processes have open: once, even if several have.
    pub fn add_nameless(&mut self, about: &Metadata) {
        if self.nameless.insert((about.dev(), about.ino())) {
            self.add(about);
        }
    }

    fn add(&mut self, about: &Metadata) {
        self.total = self.total.saturating_add((self.measure)(about));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(folder: &Path, measure: fn(&Metadata) -> u64) -> u64 {
        let mut size = DiskUsage::new(measure, u64::MAX);
        assert!(size.add_folder(folder));
        size.total
    }

    #[test]
    fn what_a_folder_takes_is_counted_by_blocks() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a"), vec![1; 100_000]).unwrap();
        std::fs::create_dir(folder.path().join("b")).unwrap();
        std::fs::write(folder.path().join("b/empty"), "").unwrap();
        std::fs::File::create(folder.path().join("hole"))
            .unwrap()
            .set_len(1 << 40)
            .unwrap();
        std::os::unix::fs::symlink("/", folder.path().join("link")).unwrap();
        let bytes = size(folder.path(), room);
        assert!((100_000 + 4 * SMALLEST..200_000).contains(&bytes), "{bytes}");
        assert_eq!(size(folder.path(), length), 100_000 + (1 << 40) + 1);
    }

    /// The largest memory that this process has had since it was last asked, in KiB.
    fn peak() -> u64 {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
        let peak = line.split_whitespace().nth(1).unwrap().parse().unwrap();
        std::fs::write("/proc/self/clear_refs", "5").unwrap();
        peak
    }

    #[test]
    fn many_folders_below_a_long_path_take_little_memory() {
        const FOLDERS: u64 = 40_000;
        let place = tempfile::tempdir().unwrap();
        let long = std::iter::repeat_n("x".repeat(250), 15).fold(place.path().to_owned(), |path, name| path.join(name));
        std::fs::create_dir_all(&long).unwrap();
        for number in 0..FOLDERS {
            std::fs::create_dir(long.join(number.to_string())).unwrap();
        }
        peak();
        let before = peak();
        assert!(size(place.path(), room) >= FOLDERS * SMALLEST);
        let more = peak().saturating_sub(before);
        // With a path for each it would be 150 MB.
        assert!(more < 60_000, "{more} KiB");
    }

    #[test]
    fn no_more_is_added_than_anybody_wants_to_know() {
        let folder = tempfile::tempdir().unwrap();
        for name in 0..100 {
            std::fs::write(folder.path().join(name.to_string()), "").unwrap();
        }
        let mut size = DiskUsage::new(room, 10 * SMALLEST);
        assert!(size.add_folder(folder.path()));
        assert_eq!(size.total, 11 * SMALLEST);
    }
}
