//! The sessions that their clients can resume, and the messages between a connection and its session.

use std::collections::HashMap;

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;
use parking_lot::Mutex;
use tokio::sync::mpsc::UnboundedReceiver;

use super::token::Token;
use crate::shared::http::Peer;

/// A connection of a client, for the session that it is attached to.
pub struct Connection {
    /// The client's current address.
    pub peer: Peer,
    /// Receives what is for the client.
    pub client: Recipient<ToClient>,
    /// What the client does. Its end is the end of the connection: the client may come back. A session that drops it has
    /// ended, or has sent the client the last text.
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

/// Asks a session to continue with another connection. The session then sends all to it, also the reason of a refusal.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Resume {
    /// The token that proves that the session belongs to the client.
    pub token: Token,
    /// The client's new connection.
    pub connection: Connection,
}

/// The registered sessions, by the number of their tokens.
#[derive(Default)]
pub struct Sessions(Mutex<HashMap<u64, Recipient<Resume>>>);

impl Sessions {
    /// Registers a session until it ends. Returns its first token.
    pub fn register(&self, session: Recipient<Resume>) -> Token {
        let token = Token::random();
        let mut sessions = self.0.lock();
        sessions.retain(|_, session| session.connected());
        sessions.insert(token.number, session);
        token
    }

    /// The session of a token, if it has not ended.
    pub fn find(&self, token: Token) -> Option<Recipient<Resume>> {
        self.0.lock().get(&token.number).cloned().filter(Recipient::connected)
    }
}
