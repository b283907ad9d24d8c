//! Asking who is here on behalf of a request, and answers that several paths give.

use std::time::Duration;

use actix_web::HttpResponse;

use crate::simulation::census::Everybody;
use crate::simulation::places::Census;
use crate::simulation::state::AppState;

/// How long an actor may take to answer a page.
const PATIENCE: Duration = Duration::from_secs(2);

/// Who is here; nothing when the actor that knows is too busy to answer.
pub async fn everybody(server: &AppState) -> Option<Everybody> {
    let census = server.places.send(Census);
    actix_rt::time::timeout(PATIENCE, census).await.ok().and_then(Result::ok)
}

/// The answer when nobody tells.
#[must_use]
pub fn too_busy() -> HttpResponse {
    HttpResponse::ServiceUnavailable().body("Error: the server is too busy to tell.")
}
