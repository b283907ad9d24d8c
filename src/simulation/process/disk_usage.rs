//! The size of the files below a directory, also while programs change it.

use std::collections::HashSet;
use std::fs::Metadata;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Adds up files. A large file with several names, or that is found again because it was moved, counts once.
pub struct DiskUsage {
    measure: fn(&Metadata) -> u64,
    /// Counting stops above this many bytes.
    enough: u64,
    /// When to stop counting.
    until: Option<Instant>,
    total: u64,
    /// Device and inode of large files.
    met: HashSet<(u64, u64)>,
}

/// Least disk usage of a file or directory, in bytes.
pub const SMALLEST: u64 = 4096;
/// Files from this size on, in bytes, are tracked by inode.
const LARGE: u64 = 64 * 1024;
/// Limit of nested directories: the kernel resolves the whole path for each.
const DEEPEST: usize = 200;
/// How many entries of a folder are counted between two looks at the clock.
const BETWEEN_CLOCKS: usize = 64;

/// What a file or folder takes of the disk. Holes take nothing.
pub fn room(about: &Metadata) -> u64 {
    (about.blocks() * 512).max(SMALLEST)
}

/// What is in a file.
pub fn length(about: &Metadata) -> u64 {
    if about.is_dir() { 0 } else { about.len() }
}

impl DiskUsage {
    /// Adds up by this measure, to no more than `enough`.
    pub fn new(measure: fn(&Metadata) -> u64, enough: u64) -> Self {
        Self { measure, enough, until: None, total: 0, met: HashSet::new() }
    }

    /// Stops counting after this time.
    pub fn within(mut self, time: Duration) -> Self {
        self.until = Some(Instant::now() + time);
        self
    }

    /// What was added up until now.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Adds everything below a directory that there is time for. Symlinks are not followed. Returns whether no folder there was
    /// closed to this server, or nested so deep that nobody would do that but on purpose.
    pub fn add_folder(&mut self, folder: &Path) -> bool {
        let mut open: Vec<(PathBuf, usize)> = vec![(folder.to_owned(), 0)];
        let mut is_shown = true;
        while let Some((folder, depth)) = open.pop().filter(|_| !self.is_late()) {
            let entries = match std::fs::read_dir(&folder) {
                Ok(entries) => entries,
                Err(error) => {
                    // It may have been removed during the walk.
                    is_shown &= matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory);
                    continue;
                }
            };
            for (number, entry) in entries.flatten().enumerate() {
                if number % BETWEEN_CLOCKS == BETWEEN_CLOCKS - 1 && self.is_late() {
                    return is_shown;
                }
                let Ok(about) = entry.metadata() else { continue };
                self.add(&about);
                if self.total > self.enough {
                    return true;
                }
                if about.is_dir() {
                    is_shown &= depth < DEEPEST;
                    open.push((entry.path(), depth + 1));
                }
            }
        }
        is_shown
    }

    /// Adds a file that has lost its names while a process has it open.
    pub fn add_nameless(&mut self, about: &Metadata) {
        if self.met.insert((about.dev(), about.ino())) {
            self.total = self.total.saturating_add((self.measure)(about));
        }
    }

    fn is_late(&self) -> bool {
        self.until.is_some_and(|until| Instant::now() >= until)
    }

    fn add(&mut self, about: &Metadata) {
        let size = (self.measure)(about);
        let is_new = size < LARGE || self.met.insert((about.dev(), about.ino()));
        self.total = self.total.saturating_add(if is_new { size } else { SMALLEST });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(folder: &Path, measure: fn(&Metadata) -> u64) -> u64 {
        let mut size = DiskUsage::new(measure, u64::MAX);
        assert!(size.add_folder(folder));
        size.total()
    }

    #[test]
    fn what_a_folder_takes_is_counted_by_blocks() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a"), vec![1; 100_000]).unwrap();
        std::fs::create_dir(folder.path().join("b")).unwrap();
        std::fs::write(folder.path().join("b/empty"), "").unwrap();
        std::fs::File::create(folder.path().join("hole")).unwrap().set_len(1 << 40).unwrap();
        std::os::unix::fs::symlink("/", folder.path().join("link")).unwrap();
        let bytes = size(folder.path(), room);
        assert!((100_000 + 4 * SMALLEST..200_000).contains(&bytes), "{bytes}");
        assert_eq!(size(folder.path(), length), 100_000 + (1 << 40) + 1);
    }

    #[test]
    fn a_large_file_with_several_names_counts_once() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("0"), vec![1; 1_000_000]).unwrap();
        for name in 1..10 {
            std::fs::hard_link(folder.path().join("0"), folder.path().join(name.to_string())).unwrap();
        }
        let bytes = size(folder.path(), room);
        assert!((1_000_000 + 9 * SMALLEST..1_200_000).contains(&bytes), "{bytes}");
    }

    #[test]
    fn no_more_is_added_than_anybody_wants_to_know() {
        let folder = tempfile::tempdir().unwrap();
        for name in 0..100 {
            std::fs::write(folder.path().join(name.to_string()), "").unwrap();
        }
        let mut size = DiskUsage::new(room, 10 * SMALLEST);
        assert!(size.add_folder(folder.path()));
        assert_eq!(size.total(), 11 * SMALLEST);
    }
}
