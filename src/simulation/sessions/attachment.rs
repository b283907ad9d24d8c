//! The attachment of a connection to the session of its simulation, and their messages.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

/// Messages from a session to its client.
#[derive(Message)]
#[rtype(result = "()")]
pub enum ToClient {
    /// The connection is attached to this session from now on.
    Attached(Attachment),
    /// A text of the protocol.
    Text(String),
    /// The last text of the protocol, and the code with which the connection then closes.
    End(String, CloseCode),
}

/// A message from a client to its session.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct FromClient {
    /// Number of the attachment; messages of an earlier attachment are ignored.
    pub attachment: u64,
    /// The content of the message.
    pub what: Said,
}

/// The content of a client's message.
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

/// The attachment of a connection to a session. Dropping it sends [`Said::Gone`] to the session.
pub struct Attachment {
    number: u64,
    session: Recipient<FromClient>,
}

impl Attachment {
    /// Attaches a connection to a session; `number` is unique among the session's attachments.
    pub fn new(session: Recipient<FromClient>, number: u64) -> Self {
        Self { number, session }
    }

    /// Sends a message to the session.
    pub fn say(&self, what: Said) {
        // A session that has ended has notified its client.
        self.session.do_send(FromClient { attachment: self.number, what });
    }
}

impl Drop for Attachment {
    fn drop(&mut self) {
        self.say(Said::Gone);
    }
}
