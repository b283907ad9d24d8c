//! Routes of the simulation server's pages, with their assets and event stream, and of Webots' own viewer: the monitor, and
//! the page on which an administrator watches a simulation.

use actix_files::NamedFile;
use actix_web::error::{ErrorInternalServerError, ErrorNotFound};
use actix_web::http::header::{self, HeaderValue};
use actix_web::{HttpRequest, HttpResponse, web};
use askama::Template;
use serde::Deserialize;

use super::access::Visitor;
use super::{pages, webots_viewer};
use crate::asset;
use crate::shared::http::assets::{self, Asset};
use crate::shared::http::routing::{GET, READ, path};
use crate::shared::http::time_span::{TimeSpan, csv_file};
use crate::shared::http::{ConnectionKind, FOREIGN_SCRIPTS, OWN_FILES, PageView, VIEWER, html, sign_in};
use crate::simulation::ends::{csv, last_lines, output_file};
use crate::simulation::snapshot::Simulation;
use crate::simulation::state::AppState;

/// Assets of this server's page, besides those of all pages.
static ASSETS: [Asset; 5] = [
    asset!("charts.css"),
    asset!("charts.js"),
    asset!("chart.js"),
    asset!("simulation_monitor.js"),
    asset!("watch.js"),
];
/// Size of the end of an output that is shown, in bytes: all that is kept of an ended simulation, with its events.
const MAX_TAIL: u64 = 96 * 1024;

/// The page `/watch`.
#[derive(Template)]
#[template(path = "simulation/watch.html")]
struct Watch<'a> {
    simulation: &'a Simulation,
    /// The page of the class, if a session server of the fleet has one.
    class: Option<String>,
    /// The path of the stream, with a token for one connection.
    stream: String,
    /// Webots' own viewer, if this server has it.
    script: Option<&'static str>,
}

/// The page that holds Webots' own viewer.
#[derive(Template)]
#[template(path = "session/webots_viewer.html")]
struct WebotsViewer;

/// Adds the routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/monitor", READ, monitor))
        .service(path("/events", GET, events))
        .service(path("/history", GET, history))
        .service(path("/output", GET, output))
        .service(path("/simulations.csv", GET, records))
        .service(path("/watch", GET, watch))
        .service(path("/webots-viewer", READ, viewer))
        .service(path("/assets/{name}", READ, asset))
        .service(path("/wwi/{path:.*}", GET, wwi));
}

async fn monitor(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let visitor = Visitor::of(&request, &server)?;
    let page = async {
        let view = view(&server, visitor).await?;
        pages::monitor(&server, &view, visitor)
    };
    if visitor == Visitor::Administrator {
        return Ok(html(page.await, OWN_FILES));
    }
    let page = async {
        page.await
            .map_err(|error| ErrorInternalServerError(format!("Error: {error}.")))
    };
    server.monitor.answer(&request, OWN_FILES, page).await
}

async fn view(server: &AppState, visitor: Visitor) -> Result<PageView, askama::Error> {
    let snapshot = server.slots.snapshot();
    let usages = server.usages(&snapshot).await;
    pages::view(server, &snapshot, &usages, visitor)
}

async fn events(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let permit = server
        .connections
        .admit(ConnectionKind::Page, server.config.trusted_proxies.peer(&request))?;
    let visitor = Visitor::of(&request, &server)?;
    let shown = server.clone();
    let render = move || {
        let server = shown.clone();
        async move {
            let view = view(&server, visitor).await;
            view.inspect_err(|error| log::error!("the monitor page can't be rendered: {error}"))
                .ok()
        }
    };
    let live = if visitor == Visitor::Administrator {
        &server.administrators
    } else {
        &server.live
    };
    Ok(live.listen(permit, server.phase.subscribe(), render))
}

async fn history(server: web::Data<AppState>) -> HttpResponse {
    HttpResponse::Ok().json(&server.readings.borrow().history)
}

async fn asset(request: HttpRequest) -> HttpResponse {
    assets::answer(&request, &ASSETS)
}

/// Which simulation, and by which viewer.
#[derive(Deserialize)]
struct Which {
    id: String,
    #[serde(default)]
    viewer: String,
}

/// The last output lines of a simulation, running or ended. They may be private, so the administrator's password
/// protects them if one is configured.
async fn output(
    request: HttpRequest,
    which: web::Query<Which>,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    if server.admin_auth.is_on() {
        server.admin_auth.reader(&request)?;
    }
    let logs = server.config.records();
    let tail =
        web::block(move || output_file(&logs, &which.id).and_then(|file| last_lines(&file, MAX_TAIL).ok())).await;
    let tail = tail?.ok_or_else(|| ErrorNotFound("Error: nothing is kept of this simulation."))?;
    Ok(HttpResponse::Ok()
        .insert_header((
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; frame-ancestors 'none'",
        ))
        .content_type("text/plain; charset=utf-8")
        .body(tail))
}

/// The lines of `simulations.csv` of a span of time.
async fn records(
    request: HttpRequest,
    span: web::Query<TimeSpan>,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    server.admin_auth.reader(&request)?;
    let span = span.in_utc();
    let logs = server.config.records();
    let lines = web::block(move || csv::lines(&logs, &span)).await?;
    Ok(csv_file(csv::HEADING, &lines))
}

/// A file of Webots' own viewer.
async fn wwi(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let path = request.match_info().query("path").to_owned();
    let file = web::block(move || {
        let file = webots_viewer::file_below(&webots_viewer::folder(&server.config)?, &path)?;
        NamedFile::open(file).ok()
    });
    let file = file
        .await?
        .ok_or_else(|| ErrorNotFound("Error: there is no such file."))?;
    let mut response = file.disable_content_disposition().into_response(&request);
    response
        .headers_mut()
        .insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    Ok(response)
}

/// The token in the page is new each time: the page's URL, which may be kept or sent to others, is useless without the
/// password.
async fn watch(
    request: HttpRequest,
    which: web::Query<Which>,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    if let Err(error) = server.admin_auth.reader(&request) {
        return Ok(sign_in::refuse(error, &request, &format!("watch?id={}", which.id)));
    }
    let snapshot = server.slots.snapshot();
    let simulation = snapshot
        .simulations
        .iter()
        .find(|simulation| simulation.id.to_string() == which.id);
    let found = simulation.and_then(|simulation| Some((simulation, server.slots.watch(simulation.id)?)));
    let (simulation, token) = found.ok_or_else(|| ErrorNotFound("Error: this simulation does not stream."))?;
    let installed = webots_viewer::folder(&server.config).map(|_| webots_viewer::PATH);
    let page = Watch {
        simulation,
        class: server.class_page(),
        stream: format!("stream/{}", token.reveal()),
        script: installed.filter(|_| which.viewer != "small"),
    };
    Ok(html(page.render(), VIEWER))
}

/// Webots' own viewer shows content of worlds: it runs in an embedded page with an origin of its own.
async fn viewer() -> HttpResponse {
    html(WebotsViewer.render(), FOREIGN_SCRIPTS)
}
