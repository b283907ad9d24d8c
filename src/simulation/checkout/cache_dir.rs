//! The directory `cacheDir`, which only one server may use.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The directory `cacheDir`, locked until this is dropped or the process exits.
pub struct CacheDir {
    /// The folder itself, without links.
    pub folder: PathBuf,
    _lock: File,
}

/// Time for which a killed server may still hold the lock: a child forked just before keeps the descriptor until
/// `execve`.
const LOCK_WAIT: Duration = Duration::from_secs(1);
/// Interval between two attempts to lock.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

impl CacheDir {
    /// Creates the directory if necessary, and locks it. Blocks for up to a second, which is acceptable during start.
    ///
    /// # Errors
    /// When the directory can't be created, or another server uses it.
    pub fn claim(folder: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let folder = folder.canonicalize()?;
        let lock = File::options().write(true).create(true).truncate(false).open(folder.join("lock"))?;
        let deadline = Instant::now() + LOCK_WAIT;
        loop {
            match lock.try_lock() {
                Ok(()) => return Ok(Self { folder, _lock: lock }),
                Err(TryLockError::WouldBlock) if Instant::now() < deadline => std::thread::sleep(RETRY_INTERVAL),
                Err(TryLockError::WouldBlock) => {
                    let words = "another simulation server uses it, and each needs one of its own";
                    return Err(io::Error::new(io::ErrorKind::ResourceBusy, words));
                }
                Err(TryLockError::Error(error)) => return Err(error),
            }
        }
    }
}
