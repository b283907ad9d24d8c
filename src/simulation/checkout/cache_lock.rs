//! Locks of cached repositories, and how those who tidy up learn that one is free.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::Notify;

/// Whether there is something to tidy up.
#[derive(Debug, Default)]
pub struct Work {
    /// Something that could not be removed waits until nobody uses it.
    pub left_over: AtomicBool,
    /// Wakes who tidies up.
    pub wake: Notify,
}

/// Tells that a repository is no longer in use.
#[derive(Debug)]
pub struct Departure(pub Arc<Work>);

/// Between two looks at a lock that somebody else holds.
const PATIENCE: Duration = Duration::from_millis(20);
impl Drop for Departure {
    fn drop(&mut self) {
        if self.0.left_over.load(Ordering::Relaxed) {
            self.0.wake.notify_one();
        }
    }
}

/// A file that belongs to a repository.
#[must_use]
pub fn beside(path: &Path, extension: &str) -> PathBuf {
    // Names of repositories have no dots.
    path.with_extension(extension)
}

/// Opens one of the files that are locked in place of a repository. They stay as long as there is one.
///
/// # Errors
/// When it can't be made.
pub fn lock_file(path: &Path, extension: &str) -> io::Result<File> {
    File::options().create(true).append(true).open(beside(path, extension))
}

/// Whether a file that was locked is still the one that others find.
#[must_use]
pub fn is_there(path: &Path, extension: &str, lock: &File) -> bool {
    let (there, here) = (beside(path, extension).metadata(), lock.metadata());
    there.is_ok_and(|there| here.is_ok_and(|here| (there.dev(), there.ino()) == (here.dev(), here.ino())))
}

/// Removes the files that are locked in place of a repository that is not there, unless somebody uses them. Others may
/// have them open: whoever has got a lock looks whether it is still there.
pub fn remove_locks(path: &Path, lock: &File) {
    let is_nothing = || !path.exists() && !beside(path, "damaged").exists();
    if is_nothing() && lock.try_lock().is_ok() && is_nothing() && is_there(path, "use", lock) {
        std::fs::remove_file(beside(path, "fetch")).ok();
        std::fs::remove_file(beside(path, "use")).ok();
    }
}

/// Waits until a lock is had.
///
/// # Errors
/// When the system can't lock.
pub async fn wait(mut attempt: impl FnMut() -> Result<(), TryLockError>) -> io::Result<()> {
    loop {
        match attempt() {
            Ok(()) => return Ok(()),
            Err(TryLockError::WouldBlock) => actix_rt::time::sleep(PATIENCE).await,
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}
