//! Signals to a server, and the phases of its life cycle.

use std::future::poll_fn;
use std::io;
use std::task::Poll;

use actix_rt::signal::unix::{Signal, SignalKind, signal};

/// The signals of a server. They are caught until this is dropped.
pub struct Signals(Vec<(Signal, ServerCommand)>);

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
    pub fn catch() -> io::Result<Self> {
        let commands = [
            (SignalKind::terminate(), ServerCommand::Stop),
            (SignalKind::interrupt(), ServerCommand::Stop),
            (SignalKind::hangup(), ServerCommand::Reload),
            (SignalKind::user_defined1(), ServerCommand::Drain),
        ];
        let caught = commands.into_iter().map(|(kind, command)| Ok((signal(kind)?, command)));
        caught.collect::<io::Result<_>>().map(Self)
    }

    /// Waits for the next signal.
    pub async fn next(&mut self) -> ServerCommand {
        poll_fn(|context| {
            let received = self
                .0
                .iter_mut()
                .find_map(|(signal, command)| match signal.poll_recv(context) {
                    Poll::Ready(_) => Some(*command),
                    Poll::Pending => None,
                });
            received.map_or(Poll::Pending, Poll::Ready)
        })
        .await
    }
}

/// The phase of a server's life cycle, published in a watch channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// It accepts clients.
    Open,
    /// It keeps its clients, and accepts no new ones.
    Draining,
    /// The same, and another process of this server has its port.
    Superseded,
    /// It stops: connections are closed.
    Closing,
}

/// Waits until a server is closing, or another process has its port: whoever connects again finds a server.
pub async fn leaving(mut phase: tokio::sync::watch::Receiver<Phase>) {
    let is_leaving = |phase: &Phase| matches!(phase, Phase::Superseded | Phase::Closing);
    phase.wait_for(is_leaving).await.ok();
}

/// Waits until a server is closing.
pub async fn closing(mut phase: tokio::sync::watch::Receiver<Phase>) {
    // Without a sender the server has stopped already.
    phase.wait_for(|phase| *phase == Phase::Closing).await.ok();
}
