//! Restarts actors that have panicked, and gives up if that happens too often.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Display;
use std::time::{Duration, Instant};

use actix::prelude::*;

/// Limit of panics of one kind of actor within [`WINDOW`].
const MAX_PANICS: usize = 5;
const WINDOW: Duration = Duration::from_mins(1);

/// Starts an actor; `None` if it can't.
type Start<K, A> = Box<dyn Fn(&K) -> Option<Addr<A>>>;

/// All actors of one kind, by key. actix does not restart an actor that has panicked.
pub struct Supervisor<K, A: Actor> {
    kind: &'static str,
    start: Start<K, A>,
    actors: BTreeMap<K, Addr<A>>,
    panics: VecDeque<Instant>,
}

impl<K: Ord + Display, A: Actor> Supervisor<K, A> {
    /// No actors yet; `start` starts one.
    pub fn new(kind: &'static str, start: impl Fn(&K) -> Option<Addr<A>> + 'static) -> Self {
        Self { kind, start: Box::new(start), actors: BTreeMap::new(), panics: VecDeque::new() }
    }

    /// Starts an actor.
    pub fn add(&mut self, key: K) {
        if let Some(actor) = (self.start)(&key) {
            self.actors.insert(key, actor);
        }
    }

    /// Removes an actor, and returns it.
    pub fn remove(&mut self, key: &K) -> Option<Addr<A>> {
        self.actors.remove(key)
    }

    /// Returns all actors.
    pub fn all(&self) -> impl Iterator<Item = &Addr<A>> {
        self.actors.values()
    }

    /// Replaces actors that have panicked.
    ///
    /// # Errors
    /// When actors of this kind panic again and again: the server must exit and be restarted.
    pub fn restart_gone(&mut self) -> Result<(), String> {
        let now = Instant::now();
        self.actors.retain(|key, actor| {
            if actor.connected() {
                return true;
            }
            log::error!("{} {key} has panicked, a new one is started", self.kind);
            self.panics.push_back(now);
            (self.start)(key).inspect(|new| *actor = new.clone()).is_some()
        });
        while self.panics.pop_front_if(|at| now.duration_since(*at) > WINDOW).is_some() {}
        if self.panics.len() <= MAX_PANICS {
            return Ok(());
        }
        let (kind, window) = (self.kind, WINDOW.as_secs());
        Err(format!("more than {MAX_PANICS} panics of one kind of actor ({kind}) within {window} s"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Fragile;

    #[derive(Message)]
    #[rtype(result = "()")]
    struct Panic;

    impl Actor for Fragile {
        type Context = Context<Self>;
    }

    impl Handler<Panic> for Fragile {
        type Result = ();

        fn handle(&mut self, _: Panic, _: &mut Self::Context) {
            panic!("a test asks for it");
        }
    }

    #[actix_rt::test]
    async fn an_actor_that_panics_is_started_again_until_it_happens_too_often() {
        let mut supervisor = Supervisor::new("the actor", |_: &&str| Some(Fragile.start()));
        supervisor.add("one");
        supervisor.add("other");
        let other = supervisor.actors["other"].clone();
        for panics in 1..=MAX_PANICS + 1 {
            let actor = supervisor.actors["one"].clone();
            actor.send(Panic).await.unwrap_err();
            assert_eq!(supervisor.restart_gone().is_err(), panics > MAX_PANICS, "after {panics}");
            assert_ne!(supervisor.actors["one"], actor);
        }
        assert_eq!(supervisor.actors["other"], other, "one that has not panicked was replaced");
    }
}
