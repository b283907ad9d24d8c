//! Jobs that are done once for all who want the same at the same time.
//!
//! A job is a future that all who wait for it share. It runs as long as one of them waits; when the last has gone it is
//! dropped, and whatever it has started ends with it.

use std::collections::HashMap;
use std::fmt;
use std::future::Future;
use std::hash::Hash;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, Shared, WeakShared};
use parking_lot::Mutex;
use tokio::sync::watch;

/// The jobs of one kind that are under way, by what is wanted.
pub struct SingleFlight<K, T: Clone>(Mutex<HashMap<K, Job<T>>>);

struct Job<T: Clone> {
    progress: watch::Receiver<String>,
    result: WeakShared<BoxFuture<'static, T>>,
}

/// The shortest time between two steps that are told: nobody reads faster.
const BETWEEN_STEPS: Duration = Duration::from_millis(100);

impl<K: Eq + Hash, T: Clone + Send + Sync + 'static> SingleFlight<K, T> {
    /// Waits for a job, together with everybody who waits for the same. `progress` hears each step in words, also those
    /// of a job that others have started.
    pub async fn join<F>(
        &self,
        key: K,
        progress: &(impl Fn(String) + Send + Sync),
        start: impl FnOnce(watch::Sender<String>) -> F,
    ) -> T
    where
        F: Future<Output = T> + Send + 'static,
    {
        let (mut result, mut news) = self.join_or_start(key, start);
        let mut told = Instant::now().checked_sub(BETWEEN_STEPS).unwrap_or_else(Instant::now);
        loop {
            let step = async {
                // What comes too soon waits, and only the newest of it is told.
                actix_rt::time::sleep_until((told + BETWEEN_STEPS).into()).await;
                news.changed().await.map(|()| news.borrow_and_update().clone())
            };
            tokio::select! {
                done = &mut result => return done,
                Ok(step) = step => {
                    told = Instant::now();
                    progress(step);
                }
            }
        }
    }

    fn join_or_start<F>(
        &self,
        key: K,
        start: impl FnOnce(watch::Sender<String>) -> F,
    ) -> (Shared<BoxFuture<'static, T>>, watch::Receiver<String>)
    where
        F: Future<Output = T> + Send + 'static,
    {
        let mut jobs = self.0.lock();
        jobs.retain(|_, job| job.result.upgrade().is_some_and(|result| result.peek().is_none()));
        if let Some(job) = jobs.get(&key)
            && let Some(result) = job.result.upgrade()
        {
            return (result, job.progress.clone());
        }
        let (sender, progress) = watch::channel(String::new());
        // Each of those who wait has a time limit of its own; the job ends with the last of them.
        let result = start(sender).boxed().shared();
        if let Some(weak) = result.downgrade() {
            jobs.insert(key, Job { progress: progress.clone(), result: weak });
        }
        (result, progress)
    }
}

impl<K, T: Clone> Default for SingleFlight<K, T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<K, T: Clone> fmt::Debug for SingleFlight<K, T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("SingleFlight")
    }
}
