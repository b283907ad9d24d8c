//! Queries the snapshot of simulations on behalf of a request.

use std::time::Duration;

use actix_web::HttpResponse;

use crate::simulation::slots::{GetSnapshot, StopOne};
use crate::simulation::snapshot::Snapshot;
use crate::simulation::state::AppState;

/// Timeout of the slot pool's answer to a page.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// All simulations of this server; `None` if the slot pool does not answer in time.
pub async fn snapshot(server: &AppState) -> Option<Snapshot> {
    let snapshot = server.slots.send(GetSnapshot);
    actix_rt::time::timeout(ANSWER_TIMEOUT, snapshot).await.ok().and_then(Result::ok)
}

/// Stops a simulation. Returns whether there is one with this id; none when the actor is too busy to answer.
pub async fn stop_simulation(server: &AppState, id: String, why: String) -> Option<bool> {
    let stopped = server.slots.send(StopOne { id, why });
    actix_rt::time::timeout(ANSWER_TIMEOUT, stopped).await.ok().and_then(Result::ok)
}

/// The answer when the actor is too busy.
pub fn too_busy() -> HttpResponse {
    HttpResponse::ServiceUnavailable().body("Error: the server is too busy to tell.")
}
