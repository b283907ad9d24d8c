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

/// Sent to a session when the first watcher of its simulation connects, and when the last one leaves.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct Watched(pub bool);

/// The streams of this server, by the number of the token that leads to each.
#[derive(Default)]
pub struct Streams(Mutex<HashMap<u64, Stream>>);

/// The stream of a simulation, for its client or for one watcher.
#[derive(Clone)]
struct Stream {
    token: Token,
    simulation: SimulationId,
    port: u16,
    session: Recipient<Watched>,
    watcher: Option<Watcher>,
}

#[derive(Clone, Copy)]
enum Watcher {
    /// It got its token at this time.
    Issued(Instant),
    Connected,
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
    simulation: SimulationId,
    streams: Arc<Streams>,
}

/// A watcher's connection. Dropping it invalidates its token.
pub struct WatchGuard {
    number: u64,
    simulation: SimulationId,
    streams: Arc<Streams>,
}

impl Streams {
    /// Registers the stream of a simulation on this port; `session` is notified of watchers.
    pub fn register(
        self: &Arc<Self>,
        simulation: SimulationId,
        port: u16,
        session: Recipient<Watched>,
    ) -> StreamRegistration {
        let token = Token::new(rand::random());
        self.0.lock().insert(token.number(), Stream { token, simulation, port, session, watcher: None });
        StreamRegistration { token, simulation, streams: Arc::clone(self) }
    }

    /// The stream of a token, if the token is valid.
    pub fn find(&self, token: &Token) -> Option<StreamTarget> {
        let streams = self.0.lock();
        let Stream { simulation, port, watcher, .. } =
            streams.get(&token.number()).filter(|stream| stream.token == *token && stream.is_valid())?;
        Some(StreamTarget { simulation: *simulation, port: *port, read_only: watcher.is_some() })
    }

    /// Issues a token to watch a simulation; `None` if it has no stream.
    pub fn watch(&self, simulation: &str) -> Option<Token> {
        let mut streams = self.0.lock();
        streams.retain(|_, stream| stream.is_valid());
        let stream = streams.values().find(|stream| stream.simulation.to_string() == simulation)?;
        let token = Token::new(rand::random());
        let watched = Stream { token, watcher: Some(Watcher::Issued(Instant::now())), ..stream.clone() };
        streams.insert(token.number(), watched);
        Some(token)
    }

    /// Marks a watcher's token as used; `None` if it already was.
    pub fn start_watching(self: &Arc<Self>, token: &Token) -> Option<WatchGuard> {
        let mut streams = self.0.lock();
        let stream = streams.get_mut(&token.number())?;
        if !matches!(stream.watcher, Some(Watcher::Issued(_))) {
            return None;
        }
        stream.watcher = Some(Watcher::Connected);
        let simulation = stream.simulation;
        notify_session(&streams, simulation, true);
        Some(WatchGuard { number: token.number(), simulation, streams: Arc::clone(self) })
    }
}

/// Notifies a session if one watcher is connected: the first one has come, or the last one leaves.
fn notify_session(streams: &HashMap<u64, Stream>, simulation: SimulationId, is_watched: bool) {
    let is_connected = |stream: &&Stream| matches!(stream.watcher, Some(Watcher::Connected));
    let mut watching = streams.values().filter(|stream| stream.simulation == simulation).filter(is_connected);
    if let (Some(only), None) = (watching.next(), watching.next()) {
        only.session.do_send(Watched(is_watched));
    }
}

impl Stream {
    fn is_valid(&self) -> bool {
        !matches!(self.watcher, Some(Watcher::Issued(at)) if at.elapsed() >= TOKEN_TIMEOUT)
    }
}

impl StreamRegistration {
    /// The token for the simulation's client.
    pub fn token(&self) -> Token {
        self.token
    }
}

impl Drop for StreamRegistration {
    fn drop(&mut self) {
        self.streams.0.lock().retain(|_, stream| stream.simulation != self.simulation);
    }
}

impl Drop for WatchGuard {
    fn drop(&mut self) {
        let mut streams = self.streams.0.lock();
        if streams.contains_key(&self.number) {
            notify_session(&streams, self.simulation, false);
            streams.remove(&self.number);
        }
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
        for stream in streams.0.lock().values_mut() {
            if let Some(Watcher::Issued(at)) = &mut stream.watcher {
                *at = Instant::now().checked_sub(TOKEN_TIMEOUT).unwrap();
            }
        }
        assert!(streams.find(&used).is_some());
        assert_eq!(streams.find(&unused), None);
        drop(stream);
        assert!(streams.0.lock().is_empty());
    }
}
