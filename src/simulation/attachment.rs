//! How a connection is attached to the session of its simulation: the messages between them, and the registry in which a
//! client that returns finds its session by a token.

use std::collections::HashMap;
use std::fmt;

use actix::prelude::*;
use parking_lot::Mutex;
use tokio::sync::mpsc::UnboundedReceiver;

use crate::shared::domain::{Failure, ProjectUrl, View};
use crate::shared::http::Peer;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::run_id::RunId;

/// A connection of a client, for the session that it is attached to.
pub struct Connection {
    /// The client's current address.
    pub peer: Peer,
    /// Receives what is for the client.
    pub client: Recipient<ToClient>,
    /// The client's actions. They end with the connection: the client may come back. A session drops the receiver when
    /// it ends, or after it has sent the client its end.
    pub actions: UnboundedReceiver<ClientAction>,
}

/// A client that asks for a simulation, and may have one.
pub struct NewClient {
    /// Its connection.
    pub connection: Connection,
    /// Who it is.
    pub identity: ClientIdentity,
    /// Its world.
    pub world: ProjectUrl,
    /// How it wants to see that.
    pub view: View,
    /// Whether it may come back.
    pub resumable: bool,
    /// Whether it may also come back before the simulation is ready.
    pub early: bool,
}

/// Messages from a session to its client.
#[derive(Message)]
#[rtype(result = "()")]
pub enum ToClient {
    /// A text of the protocol.
    Text(String),
    /// Why there is nothing more to come. The connection then closes.
    Close(Failure),
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

/// Asks a session to continue with another connection. The session sends everything to it, including a refusal.
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
pub struct ResumableSessions(Mutex<HashMap<u64, Recipient<Resume>>>);

impl ResumableSessions {
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

/// Proves that a session or a stream belongs to a client. It never appears in a log or on a page of others, and that of
/// a session in no URL. A comparison is of numbers, so its duration reveals nothing.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Token {
    /// The same for all tokens of a session. It names the process that has given it.
    number: u64,
    secret: u128,
}

/// Number of hexadecimal digits of the number.
const DIGITS: usize = 16;

impl Token {
    /// A new token.
    pub fn random() -> Self {
        Self {
            number: RunId::number(),
            secret: rand::random(),
        }
    }

    /// The next token of the same session.
    pub fn next(self) -> Self {
        Self {
            secret: rand::random(),
            ..self
        }
    }

    /// The process that has given it.
    pub fn run(self) -> RunId {
        RunId::of(self.number)
    }

    /// Parses a token of a client; `None` if it is invalid.
    pub fn parse(text: &str) -> Option<Self> {
        let is_hex = text.len() == 3 * DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let (number, secret) = text.split_at_checked(DIGITS).filter(|_| is_hex)?;
        Some(Self {
            number: u64::from_str_radix(number, 16).ok()?,
            secret: u128::from_str_radix(secret, 16).ok()?,
        })
    }

    /// The token as text, only for its client.
    pub fn reveal(&self) -> String {
        format!("{:016x}{:032x}", self.number, self.secret)
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Token")
    }
}
