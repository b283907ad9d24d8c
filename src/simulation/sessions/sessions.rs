//! The sessions that their clients may come back to.

use std::collections::HashMap;
use std::sync::Arc;

use actix::prelude::*;
use parking_lot::Mutex;

use super::attachment::ToClient;
use super::token::Token;
use crate::shared::http::Peer;

/// Asks a session to go on with another connection, which is then attached to it. The answer is why not, in words for the
/// client.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub struct Resume {
    /// What the client proves with that the session is its own.
    pub token: Token,
    /// The connection.
    pub client: Recipient<ToClient>,
    /// Where the client is now.
    pub peer: Peer,
}

/// Where sessions are found again.
#[derive(Default)]
pub struct Sessions(Mutex<HashMap<u64, Recipient<Resume>>>);

/// A session that can be found. Dropping it ends that.
pub struct Registration {
    number: u64,
    sessions: Arc<Sessions>,
}

impl Sessions {
    /// Registers a session.
    #[must_use]
    pub fn register(self: &Arc<Self>, session: Recipient<Resume>) -> Registration {
        // Not one that an earlier run of the server has used.
        let number = rand::random();
        self.0.lock().insert(number, session);
        Registration { number, sessions: Arc::clone(self) }
    }

    /// The session that a token names, if it has not ended.
    #[must_use]
    pub fn find(&self, token: &Token) -> Option<Recipient<Resume>> {
        self.0.lock().get(&token.number()).cloned()
    }
}

impl Registration {
    /// A new token for it.
    #[must_use]
    pub fn token(&self) -> Token {
        Token::new(self.number)
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.sessions.0.lock().remove(&self.number);
    }
}
