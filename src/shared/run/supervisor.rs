//! Restarts tasks that have panicked, and gives up if that happens too often.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Display;
use std::time::{Duration, Instant};

use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

/// Limit of panics of one kind of task within [`WINDOW`].
const MAX_PANICS: usize = 5;
const WINDOW: Duration = Duration::from_mins(1);

/// Starts a task. It ends when its channel is closed; if it drops the channel before, it has panicked.
type Start<K, M> = Box<dyn Fn(&K, UnboundedReceiver<M>)>;

/// All tasks of one kind, by key, each with a channel for messages.
pub struct Supervisor<K, M> {
    kind: &'static str,
    start: Start<K, M>,
    tasks: BTreeMap<K, UnboundedSender<M>>,
    panics: VecDeque<Instant>,
}

impl<K: Ord + Display, M> Supervisor<K, M> {
    /// No tasks yet; `start` starts one.
    pub fn new(kind: &'static str, start: impl Fn(&K, UnboundedReceiver<M>) + 'static) -> Self {
        Self { kind, start: Box::new(start), tasks: BTreeMap::new(), panics: VecDeque::new() }
    }

    /// Starts a task.
    pub fn add(&mut self, key: K) {
        let (sender, receiver) = unbounded_channel();
        (self.start)(&key, receiver);
        self.tasks.insert(key, sender);
    }

    /// Ends a task.
    pub fn remove(&mut self, key: &K) {
        self.tasks.remove(key);
    }

    /// Returns the channels of all tasks.
    pub fn all(&self) -> impl Iterator<Item = &UnboundedSender<M>> {
        self.tasks.values()
    }

    /// Replaces tasks that have panicked.
    ///
    /// # Errors
    /// When tasks of this kind panic again and again: the server must exit and be restarted.
    pub fn restart_gone(&mut self) -> Result<(), String> {
        let now = Instant::now();
        for (key, sender) in self.tasks.iter_mut().filter(|(_, sender)| sender.is_closed()) {
            log::error!("{} {key} has panicked, a new one is started", self.kind);
            self.panics.push_back(now);
            let (new, receiver) = unbounded_channel();
            (self.start)(key, receiver);
            *sender = new;
        }
        while self.panics.pop_front_if(|at| now.duration_since(*at) > WINDOW).is_some() {}
        if self.panics.len() <= MAX_PANICS {
            return Ok(());
        }
        let (kind, window) = (self.kind, WINDOW.as_secs());
        Err(format!("more than {MAX_PANICS} panics of one kind of task ({kind}) within {window} s"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[actix_rt::test]
    async fn a_task_that_panics_is_started_again_until_it_happens_too_often() {
        let mut supervisor = Supervisor::new("the task", |_: &&str, mut panics: UnboundedReceiver<()>| {
            actix_rt::spawn(async move {
                assert!(panics.recv().await.is_none(), "a test asks for it");
            });
        });
        supervisor.add("one");
        supervisor.add("other");
        let other = supervisor.tasks["other"].clone();
        for panics in 1..=MAX_PANICS + 1 {
            let task = supervisor.tasks["one"].clone();
            task.send(()).unwrap();
            task.closed().await;
            assert_eq!(supervisor.restart_gone().is_err(), panics > MAX_PANICS, "after {panics}");
            assert!(!supervisor.tasks["one"].same_channel(&task));
        }
        assert!(supervisor.tasks["other"].same_channel(&other), "one that has not panicked was replaced");
    }
}
