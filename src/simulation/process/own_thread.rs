//! Runs work on a thread of its own, which may block it.

use std::future::Future;
use std::io;

use tokio::runtime::Builder;
use tokio_util::sync::CancellationToken;

/// Runs a future on a thread of the blocking pool, in a runtime of its own. On a busy machine each step of a future waits
/// until its thread gets a core: here they do not wait for the steps of others. Dropping the returned future drops it.
///
/// # Errors
/// When there is no thread or runtime for it, or it panics.
pub async fn on_own_thread<T, F>(work: impl FnOnce() -> F + Send + 'static) -> io::Result<T>
where
    T: Send + 'static,
    F: Future<Output = T>,
{
    let dropped = CancellationToken::new();
    let _guard = dropped.clone().drop_guard();
    let run = move || {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let done = runtime.block_on(dropped.run_until_cancelled_owned(work()));
        done.ok_or_else(|| io::ErrorKind::Interrupted.into())
    };
    actix_rt::task::spawn_blocking(run).await?
}
