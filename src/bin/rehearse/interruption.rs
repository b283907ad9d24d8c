//! Ctrl-C and SIGTERM.

use std::future::pending;

use tokio::signal::ctrl_c;
use tokio::signal::unix::{SignalKind, signal};

/// Waits for a signal that interrupts this program. A signal without a handler never arrives.
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
