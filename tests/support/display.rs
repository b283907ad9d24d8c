//! X displays. All tests of the machine share their numbers.

use tokio::sync::{Mutex, MutexGuard};

static DISPLAYS: Mutex<()> = Mutex::const_new(());

/// Waits until no other test of this process starts or ends displays: the number of one that is gone may be taken by
/// another at once.
pub async fn alone() -> MutexGuard<'static, ()> {
    DISPLAYS.lock().await
}
