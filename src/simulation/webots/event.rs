//! The events of a running Webots, for its session.

use std::time::Instant;

use actix::prelude::*;

use crate::simulation::sessions::Token;

/// An event of a running Webots.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum WebotsEvent {
    /// A step of its preparation or of the checkout before it, as text.
    Progress(String),
    /// A text of the protocol that its project requests, unchanged.
    Text(String),
    /// Its process was started.
    Started,
    /// It listens on this port, and this is the token for its stream.
    Listening(u16, Token),
    /// It has sent a heartbeat.
    Heartbeat,
    /// It has sent no heartbeat for this many seconds.
    Hanging(u64),
    /// It is paused and ends at this time if it stays so; `None`: that end is cancelled.
    IdleEnd(Option<Instant>),
    /// It has ended, and why.
    Exited(WebotsExit),
}

/// Why a Webots has exited.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WebotsExit {
    /// Whether it exited by itself, without an error.
    pub clean: bool,
    /// Whether this server is the cause, so that another one may accept the client: Docker has failed or stopped, or
    /// Webots has exited before it listened (it listens before it loads its world).
    pub own: bool,
    /// The reason, as text for the client.
    pub why: String,
}
