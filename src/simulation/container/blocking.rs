//! Blocking file I/O for the preparation of containers.

use super::start_error::StartError;

/// Runs blocking file I/O on the blocking thread pool.
///
/// # Errors
/// Those of `work`.
pub async fn blocking<T, E>(work: impl FnOnce() -> Result<T, E> + Send + 'static) -> Result<T, StartError>
where
    T: Send + 'static,
    E: Into<StartError> + Send + 'static,
{
    let done = actix_rt::task::spawn_blocking(work).await;
    done.map_err(|error| StartError::Server(error.to_string()))?.map_err(Into::into)
}
