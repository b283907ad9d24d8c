//! How a connection and the session of its simulation are attached to each other, and what they say.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

/// What a session has for its client.
#[derive(Message)]
#[rtype(result = "()")]
pub enum ToClient {
    /// The connection is attached to this session from now on.
    Attached(Attachment),
    /// A text of the protocol.
    Text(String),
    /// The last text of the protocol, and how the connection closes after it.
    End(String, CloseCode),
}

/// What a client has for its session.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct FromClient {
    /// Which attachment says it: that of an earlier connection has nothing more to say.
    pub attachment: u64,
    /// What it says.
    pub what: Said,
}

/// What a client says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Said {
    /// Restore this file below `controllers/`.
    ResetController(String),
    /// Its simulation, which is paused, is to stay.
    Keep,
    /// It needs its simulation no longer.
    Left,
    /// Its connection has ended.
    Gone,
}

/// The attachment of a connection to a session. Dropping it tells the session that its client has gone.
pub struct Attachment {
    number: u64,
    session: Recipient<FromClient>,
}

impl Attachment {
    /// Attaches a connection to a session; `number` tells it from others.
    #[must_use]
    pub fn new(session: Recipient<FromClient>, number: u64) -> Self {
        Self { number, session }
    }

    /// Says something to the session.
    pub fn say(&self, what: Said) {
        // A session that has ended has told its client so.
        self.session.do_send(FromClient { attachment: self.number, what });
    }
}

impl Drop for Attachment {
    fn drop(&mut self) {
        self.say(Said::Gone);
    }
}
