//! Queries the registry on behalf of a request.

use std::sync::Arc;
use std::time::Duration;

use actix_web::HttpResponse;

use crate::session::fleet::{FleetStatus, GetStatus};
use crate::session::state::AppState;

/// Timeout of the registry's answer.
const STATUS_TIMEOUT: Duration = Duration::from_secs(2);

/// The status of the fleet; `None` if the registry does not answer in time.
pub async fn status(server: &AppState) -> Option<Arc<FleetStatus>> {
    let status = server.registry.send(GetStatus);
    actix_rt::time::timeout(STATUS_TIMEOUT, status).await.ok().and_then(Result::ok)
}

/// Answers with the status of the fleet, or with 503 if the registry does not answer in time.
pub async fn with_status(server: &AppState, answer: impl FnOnce(&FleetStatus) -> HttpResponse) -> HttpResponse {
    match status(server).await {
        Some(status) => answer(&status),
        None => HttpResponse::ServiceUnavailable().body("Error: the server is too busy to tell."),
    }
}
