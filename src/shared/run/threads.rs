//! The limit of processes and threads that the system sets for a user, a unit or a container.

use std::thread::{Builder, available_parallelism, scope};

use parking_lot::Mutex;

/// Threads and processes that a server needs besides its HTTP workers: its own, and those of a first checkout.
const NEEDED: usize = 32;
/// Stack size of a thread that only waits.
const STACK: usize = 64 * 1024;

/// Tries whether the system lets this program start as many threads as a server needs. actix and tokio panic if it
/// refuses one.
///
/// # Errors
/// A message with the number that can be started.
pub fn check_threads() -> Result<(), String> {
    let needed = NEEDED + available_parallelism().map_or(1, usize::from);
    let gate = Mutex::new(());
    let closed = gate.lock();
    let started = scope(|scope| {
        let wait = || drop(gate.lock());
        let start = |_: &usize| Builder::new().stack_size(STACK).spawn_scoped(scope, wait).is_ok();
        let started = (0..needed).take_while(start).count();
        drop(closed);
        started
    });
    if started == needed {
        return Ok(());
    }
    Err(format!(
        "only {started} more processes and threads may be started, which is not enough for a server, it needs {needed}; \
         ulimit -Hu, or TasksMax of systemd, allows more"
    ))
}
