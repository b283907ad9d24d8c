//! Ctrl-C and SIGTERM.

use std::future::pending;

use tokio::signal::ctrl_c;
use tokio::signal::unix::{SignalKind, signal};

/// Waits until this program is to end early. A signal that can't be waited for never comes.
pub(crate) async fn interruption() {
    let terminated = async {
        match signal(SignalKind::terminate()) {
            Ok(mut signal) => signal.recv().await,
            Err(_) => pending().await,
        }
    };
    tokio::select! {
        Some(()) = terminated => {}
        Ok(()) = ctrl_c() => {}
        else => pending().await,
    }
}
