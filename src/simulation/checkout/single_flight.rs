//! Jobs that run once for all concurrent callers with the same key.
//!
//! A job is a future that all its waiters share. It runs as long as one of them waits; when the last waiter drops it,
//! it is cancelled with everything it has started.

use std::collections::HashMap;
use std::future::Future;
use std::hash::Hash;
use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, WeakShared, pending};
use parking_lot::Mutex;
use tokio::sync::watch;

/// The jobs of one kind that are in progress, by key.
pub struct SingleFlight<K, T: Clone>(Mutex<HashMap<K, Job<T>>>);

struct Job<T: Clone> {
    progress: watch::Receiver<String>,
    result: WeakShared<BoxFuture<'static, T>>,
}

/// Receives each step of a job as text.
pub type OnProgress<'job> = &'job (dyn Fn(String) + Send + Sync);
/// The same, for a job on another thread.
pub type SharedProgress = Arc<dyn Fn(String) + Send + Sync>;

/// Shortest interval between two steps that are sent to a waiter.
const STEP_INTERVAL: Duration = Duration::from_millis(100);

impl<K: Eq + Hash, T: Clone + Send + Sync + 'static> SingleFlight<K, T> {
    /// Joins the job with this key, or starts it. `progress` receives each step as text, also if another caller has
    /// started the job.
    pub async fn join<F>(&self, key: K, progress: OnProgress<'_>, start: impl FnOnce(watch::Sender<String>) -> F) -> T
    where
        F: Future<Output = T> + Send + 'static,
    {
        let (result, mut steps) = {
            let mut jobs = self.0.lock();
            jobs.retain(|_, job| job.result.upgrade().is_some_and(|result| result.peek().is_none()));
            let known = jobs
                .get(&key)
                .and_then(|job| Some((job.result.upgrade()?, job.progress.clone())));
            known.unwrap_or_else(|| {
                let (sender, progress) = watch::channel(String::new());
                // Each waiter has a timeout of its own; the job ends with the last of them.
                let result = start(sender).boxed().shared();
                let job = result.downgrade().map(|result| Job {
                    progress: progress.clone(),
                    result,
                });
                jobs.extend(job.map(|job| (key, job)));
                (result, progress)
            })
        };
        let send_steps = async {
            while steps.changed().await.is_ok() {
                progress(steps.borrow_and_update().clone());
                // Within this time only the newest step is sent.
                actix_rt::time::sleep(STEP_INTERVAL).await;
            }
            pending().await
        };
        tokio::select! {
            done = result => done,
            never = send_steps => never,
        }
    }
}

impl<K, T: Clone> Default for SingleFlight<K, T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}
