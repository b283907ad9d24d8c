//! The folder `cacheDir`, which one server has to itself.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The folder `cacheDir`, locked as long as this lives and the process runs.
#[derive(Debug)]
pub struct CacheDir {
    folder: PathBuf,
    _lock: File,
}

/// How long a server that was killed may still hold the lock: a child that it was just starting has it until it runs.
const LAST_BREATH: Duration = Duration::from_secs(1);
/// Time between two attempts to lock.
const PAUSE: Duration = Duration::from_millis(20);

impl CacheDir {
    /// Makes the folder if need be, and locks it. Blocks for up to a second: for the start.
    ///
    /// # Errors
    /// When the folder can't be made, or another server uses it.
    pub fn claim(folder: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let folder = folder.canonicalize()?;
        let lock = File::create(folder.join("lock"))?;
        let deadline = Instant::now() + LAST_BREATH;
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
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.folder
    }
}
