//! Actions of administrators.

use actix_web::error::ErrorNotFound;
use actix_web::{HttpRequest, HttpResponse, web};
use serde::Deserialize;
use serde_json::json;

use crate::shared::http::routing::{POST, json_body, path};
use crate::simulation::state::AppState;

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
    let by = administrator.to_string();
    let stopped = server.stop(&[id.into_inner()], &reason, &by).await;
    if stopped.is_empty() {
        return Err(ErrorNotFound(
            "Error: there is no such simulation, or its process does not answer; it may have ended.",
        ));
    }
    Ok(HttpResponse::Accepted().json(json!({"stopped": stopped, "failed": []})))
}
