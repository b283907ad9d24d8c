//! The sessions that their clients can resume.

use std::collections::HashMap;
use std::sync::Arc;

use actix::prelude::*;
use parking_lot::Mutex;

use super::attachment::ToClient;
use super::token::Token;
use crate::shared::http::Peer;

/// Asks a session to continue with another connection, which is then attached to it. The answer is the reason of a
/// refusal, as text for the client.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub struct Resume {
    /// The token that proves that the session belongs to the client.
    pub token: Token,
    /// The client's new connection.
    pub client: Recipient<ToClient>,
    /// The client's current address.
    pub peer: Peer,
}

/// The registered sessions, by number.
#[derive(Default)]
pub struct Sessions(Mutex<HashMap<u64, Recipient<Resume>>>);

/// The registration of a session. Dropping it removes the session.
pub struct Registration {
    number: u64,
    sessions: Arc<Sessions>,
}

impl Sessions {
    /// Registers a session.
    pub fn register(self: &Arc<Self>, session: Recipient<Resume>) -> Registration {
        // Random, so that it differs from the numbers of earlier runs of the server.
        let number = rand::random();
        self.0.lock().insert(number, session);
        Registration { number, sessions: Arc::clone(self) }
    }

    /// The session that a token names, if it has not ended.
    pub fn find(&self, token: &Token) -> Option<Recipient<Resume>> {
        self.0.lock().get(&token.number()).cloned()
    }
}

impl Registration {
    /// Creates a new token for the session.
    pub fn token(&self) -> Token {
        Token::new(self.number)
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.sessions.0.lock().remove(&self.number);
    }
}
