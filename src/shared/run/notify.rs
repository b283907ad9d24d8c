//! Tells the service manager (systemd) what the server is doing. Without one, nothing is told.
//!
//! A watchdog is fed from here only when an actor without which the server is of no use has answered: a server that
//! hangs is ended and started again.

use std::time::Duration;

use sd_notify::NotifyState;

/// The server can be reached, and its actors run.
pub fn ready(what: &str) {
    tell(&[NotifyState::Ready, NotifyState::Status(what)]);
}

/// The server reads its configuration again. [`ready`] tells the end of it.
pub fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => tell(&[NotifyState::Reloading, now]),
        Err(error) => log::warn!("the service manager can't be told of the reload: {error}"),
    }
}

/// What the server is doing, for the administrator to read.
pub fn status(what: &str) {
    tell(&[NotifyState::Status(what)]);
}

/// The server ends in order, and why.
pub fn stopping(why: &str) {
    tell(&[NotifyState::Stopping, NotifyState::Status(why)]);
}

/// Feeds the watchdog, if there is one, each time that `answers` says so. Never ends.
///
/// `answers` may take as long as it likes: without an answer the watchdog is not fed.
pub async fn feed_watchdog(mut answers: impl AsyncFnMut() -> bool) {
    let Some(limit) = sd_notify::watchdog_enabled() else {
        return std::future::pending().await;
    };
    loop {
        if answers().await {
            tell(&[NotifyState::Watchdog]);
        }
        actix_rt::time::sleep(pause(limit)).await;
    }
}

/// Between two meals: short enough that one may come late.
fn pause(limit: Duration) -> Duration {
    limit / 3
}

fn tell(state: &[NotifyState<'_>]) {
    // A server that can't talk to its service manager still serves; systemd will end it if it must hear from it.
    if let Err(error) = sd_notify::notify(state) {
        log::warn!("the service manager can't be told: {error}");
    }
}
