//! How much the files below a folder take, also while programs change it.

use std::collections::HashSet;
use std::fs::Metadata;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::process_tree;

/// Adds up files. One that has several names, or is met again because it was moved meanwhile, counts once if it is large.
#[derive(Debug)]
pub struct FolderSize {
    measure: fn(&Metadata) -> u64,
    /// Nobody wants to know how much more it is.
    enough: u64,
    total: u64,
    /// Device and inode of large files.
    met: HashSet<(u64, u64)>,
}

/// Folders are closed to this server, or nested so deep that nobody would do that but on purpose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unknown;

/// The least that a name takes of the disk, in bytes.
pub const SMALLEST: u64 = 4096;
/// Files from this size on, in bytes, are remembered.
const LARGE: u64 = 64 * 1024;
/// How the kernel shows that a file has no name.
const NAMELESS: &[u8] = b" (deleted)";
/// How many folders may be in each other: a look at each takes time for all above it.
const DEEPEST: usize = 200;

/// What a file or folder takes of the disk. Holes take nothing.
#[must_use]
pub fn room(about: &Metadata) -> u64 {
    (about.blocks() * 512).max(SMALLEST)
}

/// What a folder takes of the disk; nothing where nobody can tell, since folders in it are closed or too deep.
#[must_use]
pub fn room_of(folder: &Path) -> Option<u64> {
    let mut size = FolderSize::new(room, u64::MAX);
    size.add_folder(folder).ok().map(|()| size.total())
}

/// What is in a file.
#[must_use]
pub fn length(about: &Metadata) -> u64 {
    if about.is_dir() { 0 } else { about.len() }
}

impl FolderSize {
    /// Adds up by this measure, to no more than `enough`.
    #[must_use]
    pub fn new(measure: fn(&Metadata) -> u64, enough: u64) -> Self {
        Self { measure, enough, total: 0, met: HashSet::new() }
    }

    /// What was added up until now.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Adds everything below a folder. Links are not followed.
    ///
    /// # Errors
    /// When there is more than anybody can tell; the rest is added.
    pub fn add_folder(&mut self, folder: &Path) -> Result<(), Unknown> {
        let mut open: Vec<(PathBuf, usize)> = vec![(folder.to_owned(), 0)];
        let mut all = Ok(());
        while let Some((folder, depth)) = open.pop() {
            let entries = match std::fs::read_dir(&folder) {
                Ok(entries) => entries,
                // It was removed meanwhile.
                Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => continue,
                Err(_) => {
                    all = Err(Unknown);
                    continue;
                }
            };
            for entry in entries.flatten() {
                let Ok(about) = entry.metadata() else { continue };
                self.add(&about);
                if self.total > self.enough {
                    return Ok(());
                }
                if about.is_dir() {
                    all = if depth < DEEPEST { all } else { Err(Unknown) };
                    open.push((entry.path(), depth + 1));
                }
            }
        }
        all
    }

    /// Adds the files without a name that a process, or one that descends from it, has open on the disk of a folder: they
    /// take room until they are closed. Each counts once. `within` is where they were, as this server sees it. Files of
    /// processes that nobody may look into are not found.
    pub fn add_nameless(&mut self, root: i32, folder: &Path, within: &Path) {
        let Ok(disk) = folder.metadata().map(|about| about.dev()) else { return };
        for pid in process_tree::tree(root) {
            let open = std::fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
            // The links are read first: a look at a file of a network may take long.
            let nameless = open.map(|entry| entry.path()).filter(|link| {
                let file = std::fs::read_link(link).unwrap_or_default();
                file.starts_with(within) && file.as_os_str().as_encoded_bytes().ends_with(NAMELESS)
            });
            let files = nameless.filter_map(|link| std::fs::metadata(link).ok());
            for about in files.filter(|about| about.is_file() && about.nlink() == 0 && about.dev() == disk) {
                if self.met.insert((about.dev(), about.ino())) {
                    self.total = self.total.saturating_add((self.measure)(&about));
                }
            }
        }
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

    fn size(folder: &Path, measure: fn(&Metadata) -> u64) -> Result<u64, Unknown> {
        let mut size = FolderSize::new(measure, u64::MAX);
        size.add_folder(folder).map(|()| size.total())
    }

    #[test]
    fn what_a_folder_takes_is_counted_by_blocks() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a"), vec![1; 100_000]).unwrap();
        std::fs::create_dir(folder.path().join("b")).unwrap();
        std::fs::write(folder.path().join("b/empty"), "").unwrap();
        std::fs::File::create(folder.path().join("hole")).unwrap().set_len(1 << 40).unwrap();
        std::os::unix::fs::symlink("/", folder.path().join("link")).unwrap();
        let bytes = size(folder.path(), room).unwrap();
        assert!((100_000 + 4 * SMALLEST..200_000).contains(&bytes), "{bytes}");
        assert_eq!(size(folder.path(), length), Ok(100_000 + (1 << 40) + 1));
    }

    #[test]
    fn a_large_file_with_several_names_counts_once() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("0"), vec![1; 1_000_000]).unwrap();
        for name in 1..10 {
            std::fs::hard_link(folder.path().join("0"), folder.path().join(name.to_string())).unwrap();
        }
        let bytes = size(folder.path(), room).unwrap();
        assert!((1_000_000 + 9 * SMALLEST..1_200_000).contains(&bytes), "{bytes}");
    }

    #[test]
    fn no_more_is_added_than_anybody_wants_to_know() {
        let folder = tempfile::tempdir().unwrap();
        for name in 0..100 {
            std::fs::write(folder.path().join(name.to_string()), "").unwrap();
        }
        let mut size = FolderSize::new(room, 10 * SMALLEST);
        size.add_folder(folder.path()).unwrap();
        assert_eq!(size.total(), 11 * SMALLEST);
    }

    #[test]
    fn folders_that_are_too_deep_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let mut deepest = std::fs::File::open(folder.path()).unwrap();
        for level in 0..3000 {
            assert_eq!(size(folder.path(), room).is_err(), level > DEEPEST, "{level}");
            if level == DEEPEST + 2 {
                break;
            }
            nix::sys::stat::mkdirat(&deepest, "nested", nix::sys::stat::Mode::S_IRWXU).unwrap();
            let flags = nix::fcntl::OFlag::O_DIRECTORY;
            deepest = nix::fcntl::openat(&deepest, "nested", flags, nix::sys::stat::Mode::empty()).unwrap().into();
        }
    }

    #[test]
    fn files_without_a_name_count_once_as_long_as_somebody_has_them_open() {
        let folder = tempfile::tempdir().unwrap();
        let me = i32::try_from(std::process::id()).unwrap();
        let count = |within: &Path| {
            let mut size = FolderSize::new(room, u64::MAX);
            size.add_nameless(me, folder.path(), within);
            size.total()
        };
        let real = folder.path().canonicalize().unwrap();
        let path = folder.path().join("gone");
        std::fs::write(&path, vec![1; 50_000_000]).unwrap();
        let open = [std::fs::File::open(&path).unwrap(), std::fs::File::open(&path).unwrap()];
        std::fs::remove_file(&path).unwrap();
        assert!((50_000_000..60_000_000).contains(&count(&real)), "{}", count(&real));
        assert!(count(Path::new("/")) >= 50_000_000, "{}", count(Path::new("/")));
        assert_eq!(count(&real.join("elsewhere")), 0);
        drop(open);
        assert_eq!(count(&real), 0);
    }
}
