//! Messages to the service manager (systemd). Without one nothing is sent.
//!
//! Its watchdog ends and restarts a server that sends no message for too long, so a message is sent only after an actor
//! that the server can't do without has answered.

use sd_notify::NotifyState;

/// Says that the server listens on `port` and its actors run.
pub fn ready(port: u16) {
    send(&[NotifyState::Ready, NotifyState::Status(&format!("listens on port {port}"))]);
}

/// Says that the server reads its configuration again. [`ready`] says when that is done.
pub fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => send(&[NotifyState::Reloading, now]),
        Err(error) => log::warn!("the service manager can't be told of the reload: {error}"),
    }
}

/// Says what the server is doing, for `systemctl status`.
pub fn status(what: &str) {
    send(&[NotifyState::Status(what)]);
}

/// Says that the server ends in order, and why.
pub fn stopping(why: &str) {
    send(&[NotifyState::Stopping, NotifyState::Status(why)]);
}

/// Sends the watchdog, if there is one, a message three times within its limit, each after `answers` has returned true.
/// Never returns.
pub async fn feed_watchdog(mut answers: impl AsyncFnMut() -> bool) {
    let Some(limit) = sd_notify::watchdog_enabled() else {
        return std::future::pending().await;
    };
    loop {
        if answers().await {
            send(&[NotifyState::Watchdog]);
        }
        actix_rt::time::sleep(limit / 3).await;
    }
}

fn send(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        log::warn!("the service manager can't be told: {error}");
    }
}
