//! Queries the registry on behalf of a request.

use std::sync::Arc;

use actix_web::HttpResponse;

use crate::session::fleet::{FleetStatus, GetStatus};
use crate::session::state::AppState;

/// The status of the fleet; `None` once the registry has stopped, and the server with it.
pub async fn status(server: &AppState) -> Option<Arc<FleetStatus>> {
    server.registry.send(GetStatus).await.ok()
}

/// Answers with the status of the fleet, or with 503 once the registry has stopped.
pub async fn with_status(server: &AppState, answer: impl FnOnce(&FleetStatus) -> HttpResponse) -> HttpResponse {
    match status(server).await {
        Some(status) => answer(&status),
        None => HttpResponse::ServiceUnavailable().body("Error: the server stops."),
    }
}
