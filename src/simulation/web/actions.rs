//! Actions of administrators: each requires their password.

use actix_web::error::ErrorNotFound;
use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse, web};
use serde::Deserialize;

use crate::shared::http::routing::{GET, POST, json_body, path};
use crate::shared::http::{refuse_action, require_administrator};
use crate::shared::text::excerpt;
use crate::simulation::protocol;
use crate::simulation::state::AppState;

/// Longest reason, in characters.
const MAX_REASON_LENGTH: usize = 300;

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/drain", POST, drain))
        .service(path("/simulations/{id}/stop", POST, stop))
        .service(path("/sign-in", GET, sign_in));
}

/// The body of a request to stop a simulation, if it has one.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct StopRequest {
    #[serde(default)]
    reason: String,
}

fn refusal(request: &HttpRequest, server: &AppState) -> Option<HttpResponse> {
    refuse_action(
        server.admin_auth.as_ref(),
        request,
        server.config.trusted_proxies.peer(request),
    )
}

async fn drain(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    if let Some(refusal) = refusal(&request, &server) {
        return refusal;
    }
    server.drain();
    HttpResponse::Accepted().body("draining")
}

/// Stops one simulation, and never its successor in the slot: an id is not used again.
async fn stop(
    request: HttpRequest,
    id: web::Path<String>,
    body: web::Payload,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    if let Some(refusal) = refusal(&request, &server) {
        return Ok(refusal);
    }
    let StopRequest { reason } = match json_body(&request, body, "{\"reason\": TEXT}").await {
        Ok(order) => order,
        Err(refusal) => return Ok(refusal),
    };
    let id = id.into_inner();
    let reason = excerpt(reason.trim(), MAX_REASON_LENGTH);
    if !server.slots.stop(&id, protocol::stopped_by_teacher(&reason)) {
        return Err(ErrorNotFound("Error: there is no such simulation; it may have ended."));
    }
    let peer = server.config.trusted_proxies.peer(&request);
    log::info!(
        "{id}: client {peer} stops it, reason: {}",
        if reason.is_empty() { "none" } else { &reason }
    );
    Ok(HttpResponse::Accepted().body("stopping"))
}

/// Has the browser ask for the password, which it then sends to the monitor page too.
async fn sign_in(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let peer = server.config.trusted_proxies.peer(&request);
    let refusal = require_administrator(server.admin_auth.as_ref(), &request, peer);
    refusal.unwrap_or_else(|| {
        HttpResponse::SeeOther()
            .insert_header((header::LOCATION, "monitor"))
            .finish()
    })
}
