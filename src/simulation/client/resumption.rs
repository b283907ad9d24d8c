//! What a session keeps for a client that returns: its token, the texts to send again, and the deadline.

use std::time::{Duration, Instant};

use actix::prelude::*;

use crate::simulation::protocol;
use crate::simulation::sessions::Token;

/// What a session keeps for a client that returns.
#[derive(Default)]
pub(super) struct Resumption {
    /// The number under which the session is registered, if its client has requested a resumable simulation.
    pub(super) number: Option<u64>,
    /// The last token that the client got; `None` before it can return.
    pub(super) token: Option<Token>,
    /// When Webots was started: the time limit starts then.
    pub(super) launched: Option<Instant>,
    /// The texts that its project requests.
    pub(super) texts: Vec<String>,
    url: String,
    /// When the simulation ends because it is paused, if it does.
    pub(super) idle_end: Option<Instant>,
    /// The timer that ends the wait for the client, if there is one.
    pub(super) deadline: Option<SpawnHandle>,
    /// Why the simulation has ended, if it has.
    pub(super) ended: Option<String>,
}

/// How many seconds are left until then, rounded up.
pub(super) fn seconds_until(then: Instant) -> u64 {
    (then.saturating_duration_since(Instant::now()) + Duration::from_millis(999)).as_secs()
}

impl Resumption {
    /// Webots is ready at this URL: from now on the client may come back. Returns the texts that offer it.
    pub(super) fn offer(&mut self, url: String, absence: Duration) -> Option<[String; 2]> {
        self.url = url;
        let token = self.token.insert(Token::new(self.number?));
        Some([protocol::absence(absence.as_secs()), protocol::resume(token)])
    }

    /// Why a client with this token may not return, as text for it; `None` if it may.
    pub(super) fn refusal(&self, token: &Token) -> Option<String> {
        match &self.token {
            None => Some(protocol::ended(None)),
            Some(own) if own != token => Some(protocol::taken_over()),
            Some(_) => self.ended.as_ref().map(|why| protocol::ended(Some(why))),
        }
    }

    /// The texts for a client that is back: those that it got before, and a new token.
    pub(super) fn texts(&mut self, timeout: u64, absence: Duration) -> Vec<String> {
        let passed = self.launched.map_or(0, |launched| launched.elapsed().as_secs());
        let mut texts = vec![protocol::shutdown_timeout(timeout.saturating_sub(passed))];
        texts.extend(self.texts.iter().cloned());
        texts.push(protocol::webots(&self.url));
        texts.extend(self.offer(self.url.clone(), absence).into_iter().flatten());
        texts.extend(self.idle_end.map(|end| protocol::idle(Some(seconds_until(end)))));
        texts
    }
}
