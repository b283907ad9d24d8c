//! The sessions that their clients can resume.

use std::collections::HashMap;

use actix::prelude::*;
use parking_lot::Mutex;

use super::attachment::Connection;
use super::token::Token;

/// Asks a session to continue with another connection, which is then attached to it. The answer is the reason of a
/// refusal, as text for the client.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub struct Resume {
    /// The token that proves that the session belongs to the client.
    pub token: Token,
    /// The client's new connection.
    pub connection: Connection,
}

/// The registered sessions, by number.
#[derive(Default)]
pub struct Sessions(Mutex<HashMap<u64, Recipient<Resume>>>);

impl Sessions {
    /// Registers a session until it ends. Returns the number for its tokens: random, so that it differs from those of
    /// earlier runs of the server.
    pub fn register(&self, session: Recipient<Resume>) -> u64 {
        let number = rand::random();
        let mut sessions = self.0.lock();
        sessions.retain(|_, session| session.connected());
        sessions.insert(number, session);
        number
    }

    /// The session that a token names, if it has not ended.
    pub fn find(&self, token: &Token) -> Option<Recipient<Resume>> {
        self.0.lock().get(&token.number()).cloned().filter(Recipient::connected)
    }
}
