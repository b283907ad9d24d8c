//! Actions of administrators.

use actix_web::error::ErrorNotFound;
use actix_web::{HttpRequest, HttpResponse, web};
use serde::Deserialize;

use crate::shared::http::routing::{POST, json_body, path};
use crate::shared::text::excerpt;
use crate::simulation::protocol;
use crate::simulation::state::AppState;

/// Longest reason, in characters.
const MAX_REASON_LENGTH: usize = 300;

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/drain", POST, drain))
        .service(path("/simulations/{id}/stop", POST, stop));
}

/// The body of a request to stop a simulation, if it has one.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct StopRequest {
    #[serde(default)]
    reason: String,
}

async fn drain(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let administrator = server.admin_auth.actor(&request)?;
    log::info!("{administrator}: drains the server");
    server.drain();
    Ok(HttpResponse::Accepted().body("draining"))
}

/// Stops one simulation, and never its successor in the slot: an id is not used again.
async fn stop(
    request: HttpRequest,
    id: web::Path<String>,
    body: web::Payload,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    let administrator = server.admin_auth.actor(&request)?;
    let StopRequest { reason } = match json_body(&request, body, "{\"reason\": TEXT}").await {
        Ok(order) => order,
        Err(refusal) => return Ok(refusal),
    };
    let id = id.into_inner();
    let reason = excerpt(reason.trim(), MAX_REASON_LENGTH);
    if !server.slots.stop(&id, protocol::stopped_by_teacher(&reason)) {
        return Err(ErrorNotFound("Error: there is no such simulation; it may have ended."));
    }
    log::info!(
        "{id}: {administrator} stops it, reason: {}",
        if reason.is_empty() { "none" } else { &reason }
    );
    Ok(HttpResponse::Accepted().body("stopping"))
}
