//! The streams of running simulations, found by tokens: that of the simulation's client, and those of watching
//! administrators.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use parking_lot::Mutex;

use crate::simulation::sessions::Token;
use crate::simulation::simulation_id::SimulationId;

/// How long a watcher's token can be used after it was issued. A used one is valid as long as its connection.
const UNUSED: Duration = Duration::from_mins(1);
/// Largest number of watchers' tokens. No further one is issued until another has ended.
const MOST_WATCHERS: usize = 1000;

/// Notifies a session whether its simulation is watched.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct Watched(pub bool);

/// The registry of streams.
#[derive(Default)]
pub struct Streams(Mutex<Open>);

#[derive(Default)]
struct Open {
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
    given: Instant,
    /// Whether its connection is open.
    watches: bool,
}

/// The stream of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Found {
    /// The simulation.
    pub simulation: SimulationId,
    /// Its port on this machine.
    pub port: u16,
    /// Whether it is a watcher's token.
    pub only_watches: bool,
}

/// A registered stream. Dropping it removes the stream and its watchers' tokens.
pub struct Registration {
    token: Token,
    streams: Arc<Streams>,
}

/// The connection of a watcher. Dropping it ends its token.
pub struct Watching {
    number: u64,
    streams: Arc<Streams>,
}

impl Streams {
    /// Registers the stream of a simulation on this port; `session` is notified whether it is watched.
    #[must_use]
    pub fn register(
        self: &Arc<Self>,
        simulation: SimulationId,
        port: u16,
        session: Recipient<Watched>,
    ) -> Registration {
        let token = Token::new(rand::random());
        self.0.lock().streams.insert(token.number(), Stream { simulation, token, port, session });
        Registration { token, streams: Arc::clone(self) }
    }

    /// The stream of a token, if the token is valid.
    #[must_use]
    pub fn find(&self, token: &Token) -> Option<Found> {
        let open = self.0.lock();
        if let Some(stream) = open.streams.get(&token.number()).filter(|stream| stream.token == *token) {
            return Some(stream.found(false));
        }
        let watcher = open.watchers.get(&token.number()).filter(|watcher| watcher.token == *token)?;
        if !watcher.is_valid() {
            return None;
        }
        open.streams.get(&watcher.stream).map(|stream| stream.found(true))
    }

    /// Issues a token for watching a simulation, if it has a stream.
    #[must_use]
    pub fn watch(&self, simulation: &str) -> Option<Token> {
        let mut open = self.0.lock();
        open.watchers.retain(|_, watcher| watcher.is_valid());
        let mut streams = open.streams.iter();
        let stream = *streams.find(|(_, stream)| stream.simulation.to_string() == simulation)?.0;
        if open.watchers.len() >= MOST_WATCHERS {
            return None;
        }
        let token = Token::new(rand::random());
        open.watchers.insert(token.number(), Watcher { token, stream, given: Instant::now(), watches: false });
        Some(token)
    }

    /// Begins to watch with a token that [`Self::find`] has found. `None` if it was used already.
    #[must_use]
    pub fn begin(self: &Arc<Self>, token: &Token) -> Option<Watching> {
        let mut open = self.0.lock();
        let watcher = open.watchers.get_mut(&token.number()).filter(|watcher| !watcher.watches)?;
        watcher.watches = true;
        let stream = watcher.stream;
        open.tell_if_only_one(stream, true);
        Some(Watching { number: token.number(), streams: Arc::clone(self) })
    }
}

impl Open {
    /// Notifies a session of its first watcher, and of the end of the last one.
    fn tell_if_only_one(&self, stream: u64, is_watched: bool) {
        let watching = self.watchers.values().filter(|watcher| watcher.watches && watcher.stream == stream).count();
        if watching == 1
            && let Some(stream) = self.streams.get(&stream)
        {
            stream.session.do_send(Watched(is_watched));
        }
    }
}

impl Stream {
    fn found(&self, only_watches: bool) -> Found {
        Found { simulation: self.simulation, port: self.port, only_watches }
    }
}

impl Watcher {
    fn is_valid(&self) -> bool {
        self.watches || self.given.elapsed() < UNUSED
    }
}

impl Registration {
    /// The token for the simulation's client.
    #[must_use]
    pub fn token(&self) -> Token {
        self.token
    }
}

impl Drop for Registration {
    fn drop(&mut self) {
        let number = self.token.number();
        let mut open = self.streams.0.lock();
        open.streams.remove(&number);
        open.watchers.retain(|_, watcher| watcher.stream != number);
    }
}

impl Drop for Watching {
    fn drop(&mut self) {
        let mut open = self.streams.0.lock();
        if let Some(stream) = open.watchers.get(&self.number).map(|watcher| watcher.stream) {
            open.tell_if_only_one(stream, false);
        }
        open.watchers.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    struct Told(Sender<bool>);

    impl Actor for Told {
        type Context = Context<Self>;
    }

    impl Handler<Watched> for Told {
        type Result = ();

        fn handle(&mut self, Watched(is_watched): Watched, _: &mut Self::Context) {
            self.0.send(is_watched).unwrap();
        }
    }

    /// Its answer comes once all earlier messages have been handled.
    #[derive(Message)]
    #[rtype(result = "()")]
    struct Barrier;

    impl Handler<Barrier> for Told {
        type Result = ();

        fn handle(&mut self, Barrier: Barrier, _: &mut Self::Context) {}
    }

    fn told() -> (Recipient<Watched>, (Addr<Told>, Receiver<bool>)) {
        let (sender, told) = channel();
        let actor = Told(sender).start();
        (actor.clone().recipient(), (actor, told))
    }

    async fn all((actor, told): &(Addr<Told>, Receiver<bool>)) -> Vec<bool> {
        actor.send(Barrier).await.unwrap();
        told.try_iter().collect()
    }

    #[actix_rt::test]
    async fn a_token_leads_to_its_simulation_as_long_as_that_runs() {
        let streams = Arc::<Streams>::default();
        let id = SimulationId::next();
        let stream = streams.register(id, 2001, told().0);
        let other = streams.register(SimulationId::next(), 2002, told().0);
        let token = stream.token();
        assert_eq!(streams.find(&token), Some(Found { simulation: id, port: 2001, only_watches: false }));
        assert_eq!(streams.find(&other.token()).unwrap().port, 2002);
        // The same number with another secret.
        assert_eq!(streams.find(&Token::new(token.number())), None);
        drop(stream);
        assert_eq!(streams.find(&token), None);
        assert!(streams.find(&other.token()).is_some());
    }

    #[actix_rt::test]
    async fn who_watches_has_a_token_for_one_connection_and_the_session_hears_of_it() {
        let streams = Arc::<Streams>::default();
        let (session, told) = told();
        let id = SimulationId::next();
        let stream = streams.register(id, 2001, session);
        assert!(streams.watch("20261122T220517042-17").is_none(), "no such simulation");
        let [one, two] = [(); 2].map(|()| streams.watch(&id.to_string()).unwrap());
        assert_eq!(streams.find(&one), Some(Found { simulation: id, port: 2001, only_watches: true }));
        assert!(streams.begin(&stream.token()).is_none(), "it is no token for watching");
        assert!(all(&told).await.is_empty());
        let first = streams.begin(&one).unwrap();
        assert!(streams.begin(&one).is_none(), "it is used");
        let second = streams.begin(&two).unwrap();
        assert_eq!(all(&told).await, [true]);
        drop(first);
        assert_eq!(streams.find(&one), None);
        assert!(all(&told).await.is_empty());
        drop(second);
        assert_eq!(all(&told).await, [false]);
        let third = streams.watch(&id.to_string()).unwrap();
        drop(stream);
        assert_eq!(streams.find(&third), None);
        assert!(streams.0.lock().watchers.is_empty());
    }

    #[actix_rt::test]
    async fn a_token_that_was_not_used_for_a_minute_is_none() {
        let streams = Arc::<Streams>::default();
        let id = SimulationId::next();
        let _stream = streams.register(id, 2001, told().0);
        let [used, unused] = [(); 2].map(|()| streams.watch(&id.to_string()).unwrap());
        let _watching = streams.begin(&used).unwrap();
        for watcher in streams.0.lock().watchers.values_mut() {
            watcher.given = Instant::now().checked_sub(UNUSED).unwrap();
        }
        assert!(streams.find(&used).is_some());
        assert_eq!(streams.find(&unused), None);
    }
}
