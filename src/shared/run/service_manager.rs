//! Messages to the service manager (systemd). Without one, no message is sent.
//!
//! Its watchdog kills and restarts a server that sends no message for too long. A message is sent only if the server
//! still works, see [`feed_watchdog`].

use sd_notify::NotifyState;

/// Reports that the server listens on `port` and its actors run.
pub fn ready(port: u16) {
    send(&[
        NotifyState::Ready,
        NotifyState::Status(&format!("listens on port {port}")),
    ]);
}

/// Reports that this process is the server's main one from now on. Only the one that was so far may.
pub fn main_process(pid: u32) {
    send(&[NotifyState::MainPid(pid)]);
}

/// Reports that the server stops in an orderly way, and why.
pub fn stopping(why: &str) {
    send(&[NotifyState::Stopping, NotifyState::Status(why)]);
}

/// Checks `answers` three times within the limit of the watchdog, and sends a message each time it returns true.
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
