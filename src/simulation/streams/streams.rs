//! The streams of running simulations by token: the token of the simulation's client, and those of watching
//! administrators.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use parking_lot::Mutex;

use crate::simulation::sessions::Token;
use crate::simulation::simulation_id::SimulationId;

/// Timeout of a watcher's token that is not used. A used one is valid as long as its connection.
const TOKEN_TIMEOUT: Duration = Duration::from_mins(1);
/// Limit of watchers' tokens.
const MAX_WATCHERS: usize = 1000;

/// Sent to a session when the first watcher of its simulation connects, and when the last one leaves.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct Watched(pub bool);

/// The streams of this server.
#[derive(Default)]
pub struct Streams(Mutex<Tables>);

#[derive(Default)]
struct Tables {
    streams: HashMap<u64, Stream>,
    watchers: HashMap<u64, Watcher>,
}

struct Stream {
    simulation: SimulationId,
    token: Token,
    port: u16,
    session: Recipient<Watched>,
}

struct Watcher {
    token: Token,
    /// The number of the stream.
    stream: u64,
    issued_at: Instant,
    /// Whether its connection is open.
    is_connected: bool,
}

/// The stream that belongs to a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamTarget {
    /// The simulation.
    pub simulation: SimulationId,
    /// Its port on this machine.
    pub port: u16,
    /// Whether the token is a watcher's, which may change nothing.
    pub read_only: bool,
}

/// Keeps a stream registered. Dropping it invalidates its tokens, those of watchers too.
pub struct StreamRegistration {
    token: Token,
    streams: Arc<Streams>,
}

/// A watcher's connection. Dropping it invalidates its token.
pub struct WatchGuard {
    number: u64,
    streams: Arc<Streams>,
}

impl Streams {
    /// Registers the stream of a simulation on this port; `session` is notified of watchers.
    #[must_use]
    pub fn register(
        self: &Arc<Self>,
        simulation: SimulationId,
        port: u16,
        session: Recipient<Watched>,
    ) -> StreamRegistration {
        let token = Token::new(rand::random());
        self.0.lock().streams.insert(token.number(), Stream { simulation, token, port, session });
        StreamRegistration { token, streams: Arc::clone(self) }
    }

    /// The stream of a token, if the token is valid.
    #[must_use]
    pub fn find(&self, token: &Token) -> Option<StreamTarget> {
        let open = self.0.lock();
        if let Some(stream) = open.streams.get(&token.number()).filter(|stream| stream.token == *token) {
            return Some(stream.target(false));
        }
        let watcher = open.watchers.get(&token.number()).filter(|watcher| watcher.token == *token)?;
        if !watcher.is_valid() {
            return None;
        }
        open.streams.get(&watcher.stream).map(|stream| stream.target(true))
    }

    /// Issues a token to watch a simulation; `None` if it has no stream, or there are too many watchers.
    #[must_use]
    pub fn watch(&self, simulation: &str) -> Option<Token> {
        let mut open = self.0.lock();
        open.watchers.retain(|_, watcher| watcher.is_valid());
        let mut streams = open.streams.iter();
        let stream = *streams.find(|(_, stream)| stream.simulation.to_string() == simulation)?.0;
        if open.watchers.len() >= MAX_WATCHERS {
            return None;
        }
        let token = Token::new(rand::random());
        open.watchers.insert(token.number(), Watcher { token, stream, issued_at: Instant::now(), is_connected: false });
        Some(token)
    }

    /// Marks a watcher's token as used; `None` if it already was.
    #[must_use]
    pub fn start_watching(self: &Arc<Self>, token: &Token) -> Option<WatchGuard> {
        let mut open = self.0.lock();
        let watcher = open.watchers.get_mut(&token.number()).filter(|watcher| !watcher.is_connected)?;
        watcher.is_connected = true;
        let stream = watcher.stream;
        open.notify_session(stream, true);
        Some(WatchGuard { number: token.number(), streams: Arc::clone(self) })
    }
}

impl Tables {
    /// Notifies a session if one watcher is connected: the first one has come, or the last one leaves.
    fn notify_session(&self, stream: u64, is_watched: bool) {
        let watching =
            self.watchers.values().filter(|watcher| watcher.is_connected && watcher.stream == stream).count();
        if watching == 1
            && let Some(stream) = self.streams.get(&stream)
        {
            stream.session.do_send(Watched(is_watched));
        }
    }
}

impl Stream {
    fn target(&self, read_only: bool) -> StreamTarget {
        StreamTarget { simulation: self.simulation, port: self.port, read_only }
    }
}

impl Watcher {
    fn is_valid(&self) -> bool {
        self.is_connected || self.issued_at.elapsed() < TOKEN_TIMEOUT
    }
}

impl StreamRegistration {
    /// The token for the simulation's client.
    #[must_use]
    pub fn token(&self) -> Token {
        self.token
    }
}

impl Drop for StreamRegistration {
    fn drop(&mut self) {
        let number = self.token.number();
        let mut open = self.streams.0.lock();
        open.streams.remove(&number);
        open.watchers.retain(|_, watcher| watcher.stream != number);
    }
}

impl Drop for WatchGuard {
    fn drop(&mut self) {
        let mut open = self.streams.0.lock();
        if let Some(stream) = open.watchers.get(&self.number).map(|watcher| watcher.stream) {
            open.notify_session(stream, false);
        }
        open.watchers.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Session;

    impl Actor for Session {
        type Context = Context<Self>;
    }

    impl Handler<Watched> for Session {
        type Result = ();

        fn handle(&mut self, _: Watched, _: &mut Self::Context) {}
    }

    #[actix_rt::test]
    async fn a_token_for_watching_that_was_not_used_for_a_minute_is_none() {
        let streams = Arc::<Streams>::default();
        let id = SimulationId::next();
        let stream = streams.register(id, 2001, Session.start().recipient());
        assert_eq!(streams.find(&Token::new(stream.token().number())), None, "the same number with another secret");
        let [used, unused] = [(); 2].map(|()| streams.watch(&id.to_string()).unwrap());
        let _watching = streams.start_watching(&used).unwrap();
        for watcher in streams.0.lock().watchers.values_mut() {
            watcher.issued_at = Instant::now().checked_sub(TOKEN_TIMEOUT).unwrap();
        }
        assert!(streams.find(&used).is_some());
        assert_eq!(streams.find(&unused), None);
        drop(stream);
        assert!(streams.0.lock().watchers.is_empty());
    }
}
