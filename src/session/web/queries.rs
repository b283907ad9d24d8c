//! Asks the registry on behalf of a request.

use std::time::Duration;

use actix::prelude::*;
use actix_web::HttpResponse;

use crate::session::fleet::FleetStatus;
use crate::session::fleet::{GetStatus, Registry};
use crate::session::state::AppState;

/// How long the registry may take to answer.
const PATIENCE: Duration = Duration::from_secs(2);

/// Asks the registry; nothing when it is too busy to answer.
pub async fn ask<M>(server: &AppState, message: M) -> Option<M::Result>
where
    M: Message<Result: Send> + Send + 'static,
    Registry: Handler<M>,
{
    let answer = server.registry.send(message);
    actix_rt::time::timeout(PATIENCE, answer).await.ok().and_then(Result::ok)
}

/// Answers with what is known of the fleet.
pub async fn with_status(server: &AppState, answer: impl FnOnce(&FleetStatus) -> HttpResponse) -> HttpResponse {
    match ask(server, GetStatus).await {
        Some(status) => answer(&status),
        None => HttpResponse::ServiceUnavailable().body("Error: the server is too busy to tell."),
    }
}
