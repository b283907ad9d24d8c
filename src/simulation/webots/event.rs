//! The events of a running Webots, for its session.

use std::time::Instant;

use actix::prelude::*;

use crate::shared::domain::Failure;
use crate::simulation::attachment::Token;
use crate::simulation::progress::Progress;

/// An event of a running Webots.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum WebotsEvent {
    /// A step of its preparation or of the checkout before it.
    Progress(Progress),
    /// A text of the protocol that its project requests, unchanged.
    Text(String),
    /// Its process was started at this time: the time limit counts from then.
    Started(Instant),
    /// It is ready.
    Ready {
        /// The port on which it listens.
        port: u16,
        /// The token for its stream.
        stream: Token,
    },
    /// It has sent a heartbeat.
    Heartbeat,
    /// It has sent no heartbeat for this many seconds.
    Hanging(u64),
    /// It is paused and ends at this time if it stays so; `None`: that end is cancelled.
    IdleEnd(Option<Instant>),
    /// It has ended, and why.
    Exited(Failure),
}
