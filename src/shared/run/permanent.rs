//! Actors and tasks that must run as long as the server.

use std::panic::AssertUnwindSafe;
use std::time::Duration;

use actix::prelude::*;
use futures_util::FutureExt;

/// Interval between two checks of an actor, and between the end of a task and its next start.
const INTERVAL: Duration = Duration::from_millis(500);

/// Waits until an actor has stopped, and returns a message about it. Such an actor has panicked, which is a bug in this
/// program.
///
/// actix does not restart an actor after a panic, and every later message to it fails. The server must exit, and its
/// service manager restarts it.
pub async fn stopped<A: Actor>(name: &str, actor: Addr<A>) -> String {
    while actor.connected() {
        actix_rt::time::sleep(INTERVAL).await;
    }
    format!("the actor {name} is gone")
}

/// Runs a task, and starts it again each time that it has panicked.
pub async fn restarted(name: &str, mut task: impl AsyncFnMut()) {
    while AssertUnwindSafe(task()).catch_unwind().await.is_err() {
        log::error!("{name} has panicked, a new one is started");
        actix_rt::time::sleep(INTERVAL).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[actix_rt::test]
    async fn a_task_that_panics_is_started_again() {
        let mut starts = 0;
        restarted("a task", async || {
            starts += 1;
            assert!(starts == 2, "this panic is part of a test");
        })
        .await;
        assert_eq!(starts, 2);
    }
}
