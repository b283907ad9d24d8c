//! The directory `cacheDir`, which only one server may use.

use std::fs::{File, Metadata, TryLockError};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;

/// The directory `cacheDir`, locked until this is dropped or the process exits.
#[derive(Debug)]
pub struct CacheDir {
    folder: PathBuf,
    _lock: File,
}

/// Time for which a killed server may still hold the lock: a child forked just before keeps the descriptor until
/// `execve`.
const LOCK_WAIT: Duration = Duration::from_secs(1);
/// Interval between two attempts to lock.
const PAUSE: Duration = Duration::from_millis(20);

impl CacheDir {
    /// Creates the directory if necessary, and locks it. Blocks for up to a second, which is acceptable during start.
    ///
    /// # Errors
    /// When the directory can't be created, or another server uses it.
    pub fn claim(folder: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let folder = folder.canonicalize()?;
        let lock = open(&folder.join("lock"))?;
        let deadline = Instant::now() + LOCK_WAIT;
        loop {
            match lock.try_lock() {
                Ok(()) => return Ok(Self { folder, _lock: lock }),
                Err(TryLockError::WouldBlock) if Instant::now() < deadline => std::thread::sleep(PAUSE),
                Err(TryLockError::WouldBlock) => {
                    let words = "another simulation server uses it, and each needs one of its own";
                    return Err(io::Error::new(io::ErrorKind::ResourceBusy, words));
                }
                Err(TryLockError::Error(error)) => return Err(error),
            }
        }
    }

    /// The folder itself, without links.
    pub fn path(&self) -> &Path {
        &self.folder
    }
}

/// Opens the lock file. Without a sandbox, a world's program may have replaced it: opening a FIFO would block, and a
/// symlink would resolve to another file.
fn open(path: &Path) -> io::Result<File> {
    let is_file = |about: &Metadata| about.is_file();
    if path.symlink_metadata().is_ok_and(|about| !is_file(&about)) {
        std::fs::remove_file(path)?;
    }
    let flags = (OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW).bits();
    let file = File::options().read(true).write(true).create(true).truncate(false).custom_flags(flags).open(path)?;
    if is_file(&file.metadata()?) { Ok(file) } else { Err(io::Error::other("lock is no regular file")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_in_the_place_of_the_lock_does_not_hinder_the_start() {
        let folder = tempfile::tempdir().unwrap();
        let (lock, other) = (folder.path().join("lock"), folder.path().join("other"));
        nix::unistd::mkfifo(&lock, nix::sys::stat::Mode::S_IRWXU).unwrap();
        drop(CacheDir::claim(folder.path()).unwrap());
        std::fs::remove_file(&lock).unwrap();
        std::os::unix::fs::symlink(&other, &lock).unwrap();
        let claimed = CacheDir::claim(folder.path()).unwrap();
        assert!(lock.symlink_metadata().unwrap().is_file() && !other.exists());
        assert!(CacheDir::claim(folder.path()).is_err());
        drop(claimed);
    }
}
