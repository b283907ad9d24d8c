//! Signals to a server, and the phases of its life cycle.

use actix_rt::signal::unix::{Signal, SignalKind, signal};

/// The signals of a server. They are caught until this is dropped.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hang_up: Signal,
    user: Signal,
}

/// The command of a signal, or of an administrator's request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerCommand {
    /// SIGTERM or SIGINT: stop.
    Stop,
    /// SIGHUP: read the configuration again.
    Reload,
    /// SIGUSR1: accept no new clients, and stop when the last one has left.
    Drain,
}

impl Signals {
    /// Starts to catch the signals.
    ///
    /// # Errors
    /// When the system does not allow it.
    pub fn catch() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: signal(SignalKind::hangup())?,
            user: signal(SignalKind::user_defined1())?,
        })
    }

    /// Waits for the next request.
    pub async fn next(&mut self) -> ServerCommand {
        tokio::select! {
            _ = self.terminate.recv() => ServerCommand::Stop,
            _ = self.interrupt.recv() => ServerCommand::Stop,
            _ = self.hang_up.recv() => ServerCommand::Reload,
            _ = self.user.recv() => ServerCommand::Drain,
        }
    }
}

/// The phase of a server's life cycle, published in a watch channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// It accepts clients.
    Open,
    /// It keeps its clients, and accepts no new ones.
    Draining,
    /// It stops: connections are closed.
    Closing,
}

/// Waits until a server is closing.
pub async fn closing(mut phase: tokio::sync::watch::Receiver<Phase>) {
    // Without a sender the server has stopped already.
    phase.wait_for(|phase| *phase == Phase::Closing).await.ok();
}
