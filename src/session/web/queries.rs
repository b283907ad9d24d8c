//! Queries the registry on behalf of a request.

use std::time::Duration;

use actix::prelude::*;
use actix_web::HttpResponse;

use crate::session::fleet::FleetStatus;
use crate::session::fleet::{GetStatus, Registry};
use crate::session::state::AppState;

/// Timeout of the registry's answer.
const PATIENCE: Duration = Duration::from_secs(2);

/// Queries the registry; `None` if it does not answer in time.
pub async fn ask<M>(server: &AppState, message: M) -> Option<M::Result>
where
    M: Message<Result: Send> + Send + 'static,
    Registry: Handler<M>,
{
    let answer = server.registry.send(message);
    actix_rt::time::timeout(PATIENCE, answer).await.ok().and_then(Result::ok)
}

/// Answers with the status of the fleet, or with 503 if the registry does not answer in time.
pub async fn with_status(server: &AppState, answer: impl FnOnce(&FleetStatus) -> HttpResponse) -> HttpResponse {
    match ask(server, GetStatus).await {
        Some(status) => answer(&status),
        None => HttpResponse::ServiceUnavailable().body("Error: the server is too busy to tell."),
    }
}
