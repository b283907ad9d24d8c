//! The attachment of a connection to the session of its simulation, and their messages.

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;
use tokio::sync::mpsc::UnboundedReceiver;

use crate::shared::http::Peer;

/// A connection of a client, for the session that it is attached to.
pub struct Connection {
    /// The client's current address.
    pub peer: Peer,
    /// Receives what is for the client.
    pub client: Recipient<ToClient>,
    /// What the client does. Its end is the end of the connection: the client may come back.
    pub actions: UnboundedReceiver<ClientAction>,
}

/// Messages from a session to its client.
#[derive(Message)]
#[rtype(result = "()")]
pub enum ToClient {
    /// A text of the protocol.
    Text(String),
    /// The last text of the protocol, and the code with which the connection then closes.
    End(String, CloseCode),
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
