//! File work of the preparation of containers.

/// Runs blocking file I/O on the blocking thread pool.
///
/// # Errors
/// Those of the work.
pub async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, String> {
    actix_rt::task::spawn_blocking(work).await.map_err(|error| error.to_string())?
}
