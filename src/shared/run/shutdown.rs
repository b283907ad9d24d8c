//! Signals that end or steer a server.

use actix_rt::signal::unix::{Signal, SignalKind, signal};

/// The signals of a server, caught from the moment this is made.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hang_up: Signal,
    user: Signal,
}

/// What a signal asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// SIGTERM or SIGINT: end in order.
    Stop,
    /// SIGHUP: read the configuration again.
    Reload,
    /// SIGUSR1: take no new clients, end when the last has gone.
    Drain,
}

impl Signals {
    /// Catches the signals.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn catch() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: signal(SignalKind::hangup())?,
            user: signal(SignalKind::user_defined1())?,
        })
    }

    /// Waits for the next request.
    pub async fn next(&mut self) -> Request {
        tokio::select! {
            _ = self.terminate.recv() => Request::Stop,
            _ = self.interrupt.recv() => Request::Stop,
            _ = self.hang_up.recv() => Request::Reload,
            _ = self.user.recv() => Request::Drain,
        }
    }
}

/// What a server is doing, as everybody in it can see from a watch channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// It takes clients.
    Open,
    /// It keeps the clients that it has, and takes no others.
    Draining,
    /// It ends: clients are told to go.
    Closing,
}

/// Waits until a server is closing.
pub async fn closing(mut phase: tokio::sync::watch::Receiver<Phase>) {
    // A sender that is gone means the same.
    phase.wait_for(|phase| *phase == Phase::Closing).await.ok();
}
