//! `/openapi.json` of both servers: what programs can ask of a fleet (`OpenAPI` 3.1).

use std::sync::LazyLock;

use actix_web::{HttpResponse, web};

use super::routing::{READ, path};

/// The description, with the version of this server.
static DESCRIPTION: LazyLock<String> =
    LazyLock::new(|| include_str!("../../../templates/openapi.json").replace("VERSION", env!("CARGO_PKG_VERSION")));

/// Adds the route to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/openapi.json", READ, description));
}

async fn description() -> HttpResponse {
    HttpResponse::Ok()
        .content_type("application/json")
        .body(DESCRIPTION.as_str())
}
