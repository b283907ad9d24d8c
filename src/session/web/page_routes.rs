//! Routes of the session server's pages, with their assets and event streams.

use std::time::SystemTime;

use actix_web::{HttpRequest, HttpResponse, Result, web};
use askama::Template;

use super::pages::{self, Viewer, WebotsViewer};
use crate::asset;
use crate::session::state::AppState;
use crate::shared::http::assets::{self, Asset};
use crate::shared::http::routing::{GET, READ, path};
use crate::shared::http::{ConnectionKind, FOREIGN_SCRIPTS, OWN_FILES, VIEWER, html};

/// Assets of this server's pages, besides those that both servers share.
const ASSETS: &[Asset] =
    &[asset!("viewer.js"), asset!("start.js"), asset!("kept.js"), asset!("lifeline.js"), asset!("session_monitor.js")];

/// Adds the routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/monitor", READ, monitor))
        .service(path("/events", GET, events))
        .service(path("/viewer", READ, viewer))
        .service(path("/webots-viewer", READ, webots_viewer))
        .service(path("/assets/{name}", READ, asset));
}

async fn monitor(server: web::Data<AppState>) -> Result<HttpResponse> {
    let (status, announcement) = (server.status().await?, server.announcements.current());
    let (clients, started) = (server.clients(), SystemTime::now() - server.started.elapsed());
    let more = (announcement.as_deref(), server.admin_auth.is_some());
    let page = pages::monitor(&status, clients, &server.client_urls, started, more);
    Ok(html(page, OWN_FILES))
}

async fn events(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let permit = match server.connections.admit(ConnectionKind::Page, server.config.trusted_proxies.peer(&request)) {
        Ok(permit) => permit,
        Err(refused) => return HttpResponse::from_error(refused),
    };
    let shown = server.clone();
    let render = move || {
        let server = shown.clone();
        async move {
            let status = server.status().await.ok()?;
            let announcement = server.announcements.current();
            let view = pages::view(&status, server.clients(), &server.client_urls, announcement.as_deref());
            view.inspect_err(|error| log::error!("the monitor page can't be rendered: {error}")).ok()
        }
    };
    server.live.listen(permit, server.phase.clone(), render)
}

async fn viewer(server: web::Data<AppState>) -> HttpResponse {
    let script = server.config.viewer_script.as_ref().map(url::Url::as_str);
    let page = Viewer { version: env!("CARGO_PKG_VERSION"), examples: &server.config.examples, script };
    html(page.render(), VIEWER)
}

/// Webots' own viewer is third-party code: it runs in an embedded page with an origin of its own.
async fn webots_viewer() -> HttpResponse {
    html(WebotsViewer { version: env!("CARGO_PKG_VERSION") }.render(), FOREIGN_SCRIPTS)
}

async fn asset(request: HttpRequest) -> HttpResponse {
    assets::answer(&request, ASSETS)
}
