//! Actors, tasks and threads that must run as long as the server.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use actix::prelude::*;
use futures_util::FutureExt;

/// Interval between two checks of an actor, and between the end of a task and its next start.
const INTERVAL: Duration = Duration::from_millis(500);
/// Limit of panics of a kind within a minute: after more of them, another restart would not help.
const MAX_PANICS: u32 = 5;

/// Counts the panics of one kind of actor or task, whose owner starts a new one after each.
#[derive(Debug)]
pub struct PanicCounter {
    /// When the first of the counted panics happened, or the counter was created.
    since: Instant,
    panics: u32,
}

impl Default for PanicCounter {
    fn default() -> Self {
        Self {
            since: Instant::now(),
            panics: 0,
        }
    }
}

impl PanicCounter {
    /// Counts and logs a panic of the actor or task `name`. More than [`MAX_PANICS`] within a minute end the server with
    /// exit code 1, so that its service manager restarts it.
    pub fn count(&mut self, name: &str) {
        if self.since.elapsed() > Duration::from_mins(1) {
            *self = Self::default();
        }
        self.panics += 1;
        if self.panics > MAX_PANICS {
            log::error!("{name} has panicked, and its kind more than {MAX_PANICS} times in a minute");
            std::process::exit(1);
        }
        log::error!("{name} has panicked, a new one is started");
    }
}

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

/// Runs a task, and restarts it after each panic, which a [`PanicCounter`] of its own counts.
pub async fn restarted(name: &str, mut task: impl AsyncFnMut()) {
    let mut panics = PanicCounter::default();
    while AssertUnwindSafe(task()).catch_unwind().await.is_err() {
        panics.count(name);
        actix_rt::time::sleep(INTERVAL).await;
    }
}

/// Starts a thread that the server needs as long as it runs. If it panics, the server exits with code 1, so that its
/// service manager restarts it.
///
/// # Errors
/// When the system can't start a thread.
pub fn thread(name: &'static str, run: impl FnOnce() + Send + 'static) -> io::Result<()> {
    let watched = move || {
        if catch_unwind(AssertUnwindSafe(run)).is_err() {
            log::error!("the thread {name} has panicked");
            std::process::exit(1);
        }
    };
    std::thread::Builder::new().name(name.to_owned()).spawn(watched)?;
    Ok(())
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

    #[actix_rt::test]
    async fn a_task_that_panics_again_and_again_ends_the_server() {
        if std::env::var_os("PANICS").is_some() {
            restarted("a task", async || panic!("this panic is part of a test")).await;
        }
        ends_with_1("a_task_that_panics_again_and_again_ends_the_server").await;
    }

    #[actix_rt::test]
    async fn a_thread_that_panics_ends_the_server() {
        if std::env::var_os("PANICS").is_some() {
            thread("a thread", || panic!("this panic is part of a test")).unwrap();
            std::future::pending::<()>().await;
        }
        ends_with_1("a_thread_that_panics_ends_the_server").await;
    }

    /// Runs this test of this module again, as a process that panics, which must end with exit code 1.
    async fn ends_with_1(test: &str) {
        let this = format!("{}::{test}", module_path!());
        let this = this.split_once("::").unwrap().1;
        let mut again = tokio::process::Command::new(std::env::current_exe().unwrap());
        let ended = again
            .args(["--exact", this])
            .env("PANICS", "")
            .kill_on_drop(true)
            .output();
        let ended = actix_rt::time::timeout(Duration::from_secs(20), ended)
            .await
            .unwrap()
            .unwrap();
        assert_eq!(ended.status.code(), Some(1));
    }
}
