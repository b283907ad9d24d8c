//! X displays. All tests on the machine share the display numbers.

use tokio::sync::{Mutex, MutexGuard};

static DISPLAYS: Mutex<()> = Mutex::const_new(());

/// Waits until no other test of this process starts or ends displays: another test may take the number of an ended
/// display at once.
pub async fn alone() -> MutexGuard<'static, ()> {
    DISPLAYS.lock().await
}
