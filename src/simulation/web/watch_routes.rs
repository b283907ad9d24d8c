//! The page on which an administrator watches a simulation, and what it loads.

use actix_web::error::ErrorNotFound;
use actix_web::{HttpRequest, HttpResponse, web};
use askama::Template;
use serde::Deserialize;

use super::webots_viewer;
use crate::shared::http::routing::{GET, READ, path};
use crate::shared::http::{ContentSecurityPolicy, html, own_sources, require_administrator};
use crate::simulation::snapshot::Simulation;
use crate::simulation::state::AppState;

/// The page `/watch`.
#[derive(Template)]
#[template(path = "simulation/watch.html")]
struct Watch<'one> {
    one: &'one Simulation,
    /// The path of the stream, with a token for one connection.
    stream: String,
    /// Webots' own viewer, where this server has it.
    script: Option<&'static str>,
}

/// The page that holds Webots' own viewer.
#[derive(Template)]
#[template(path = "session/webots_viewer.html")]
struct WebotsViewer {
    version: &'static str,
}

/// Which simulation, and by which viewer.
#[derive(Deserialize)]
struct Which {
    id: String,
    #[serde(default)]
    viewer: String,
}

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/watch", GET, watch)).service(path("/webots-viewer", READ, viewer));
}

/// The token in the page is new each time: the page's URL, which may be kept or sent to others, is useless without the
/// password.
async fn watch(
    request: HttpRequest,
    which: web::Query<Which>,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    let peer = server.config.trusted_proxies.peer(&request);
    if let Some(refusal) = require_administrator(server.admin_auth.as_ref(), &request, peer) {
        return Ok(refusal);
    }
    let snapshot = server.slots.snapshot();
    let one = snapshot.simulations.iter().find(|one| one.id.to_string() == which.id);
    let found = one.and_then(|one| Some((one, server.slots.watch(one.id)?)));
    let (one, token) = found.ok_or_else(|| ErrorNotFound("Error: this simulation does not stream."))?;
    let installed = webots_viewer::folder(&server.config).map(|_| webots_viewer::PATH);
    let (stream, script) = (format!("stream/{}", token.reveal()), installed.filter(|_| which.viewer != "small"));
    let page = Watch { one, stream, script };
    Ok(html(page.render(), &ContentSecurityPolicy::viewer(&request, &[])))
}

/// Webots' own viewer shows what worlds bring: it runs in an embedded page with an origin of its own.
async fn viewer(request: HttpRequest) -> HttpResponse {
    let page = WebotsViewer { version: env!("CARGO_PKG_VERSION") };
    html(page.render(), &ContentSecurityPolicy::foreign(&own_sources(&request)))
}
