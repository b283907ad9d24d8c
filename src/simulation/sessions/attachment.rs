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
    /// What the client does.
    pub action: ClientAction,
}

/// An action of a client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ClientAction {
    /// Restore this file below `controllers/`.
    ResetController(String),
    /// Keep its simulation, which is paused.
    Keep,
    /// End its simulation.
    Leave,
    /// End its connection; it may come back.
    Disconnect,
}

/// The attachment of a connection to a session. Dropping it sends [`ClientAction::Disconnect`] to the session.
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
    pub fn send(&self, action: ClientAction) {
        // A session that has ended has notified its client.
        self.session.do_send(FromClient { attachment: self.number, action });
    }
}

impl Drop for Attachment {
    fn drop(&mut self) {
        self.send(ClientAction::Disconnect);
    }
}
