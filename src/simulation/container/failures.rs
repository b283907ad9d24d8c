//! Failures of the preparation of containers.

use actix_rt::task::spawn_blocking;

use crate::shared::domain::{Failure, Reason};

/// The project can't be used, for this reason.
pub fn of_project(why: impl Into<String>) -> Failure {
    Failure::new(Reason::InvalidProject, why)
}

/// Docker refuses the containers of a simulation, although it works. `is_projects`: whether the project has defined one of
/// their images, which is the cause then.
pub fn refused_by_docker(is_projects: bool) -> Failure {
    let reason = if is_projects {
        Reason::InvalidProject
    } else {
        Reason::LaunchFailed
    };
    Failure::new(reason, "Docker can't start the containers of this simulation")
}

/// Runs blocking work on the blocking thread pool.
///
/// # Errors
/// Those of `work`, or its panic.
pub async fn on_thread<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> Result<T, Failure> {
    spawn_blocking(work)
        .await
        .unwrap_or_else(|error| Err(Failure::new(Reason::ServerFault, error.to_string())))
}
