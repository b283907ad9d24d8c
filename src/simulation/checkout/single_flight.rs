//! Jobs that run once for all concurrent callers with the same key.
//!
//! A job is a future that all its waiters share. It runs as long as one of them waits; when the last waiter drops it,
//! it is cancelled with everything it has started.

use std::collections::HashMap;
use std::future::Future;
use std::hash::Hash;
use std::time::Duration;

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, WeakShared, pending};
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::simulation::progress::Progress;

/// The jobs of one kind that are in progress, by key.
pub struct SingleFlight<K, T: Clone, P = Progress>(Mutex<HashMap<K, Job<T, P>>>);

struct Job<T: Clone, P> {
    progress: watch::Receiver<Option<P>>,
    result: WeakShared<BoxFuture<'static, T>>,
}

/// Sends the steps of a job to all who wait for it.
pub struct Steps<P = Progress>(watch::Sender<Option<P>>);

impl<P> Steps<P> {
    /// Sends a step.
    pub fn send(&self, step: P) {
        self.0.send_replace(Some(step));
    }
}

/// Shortest interval between two steps that are sent to a waiter.
const STEP_INTERVAL: Duration = Duration::from_millis(100);

impl<K: Eq + Hash, T: Clone + Send + Sync + 'static, P: Clone> SingleFlight<K, T, P> {
    /// Joins the job with this key, or starts it. `progress` receives each step, also if another caller has started the
    /// job.
    pub async fn join<F>(&self, key: K, progress: &(dyn Fn(P) + Send + Sync), start: impl FnOnce(Steps<P>) -> F) -> T
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
                let (sender, progress) = watch::channel(None);
                // Each waiter has a timeout of its own; the job ends with the last of them.
                let result = start(Steps(sender)).boxed().shared();
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
                let step = steps.borrow_and_update().clone();
                step.into_iter().for_each(progress);
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

impl<K, T: Clone, P> Default for SingleFlight<K, T, P> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}
