//! The simulation server's public paths: each reads the request, asks for what it needs, and maps the answer.

use std::sync::Arc;

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse, web};

use super::actions;
use super::page_routes;
use super::queries::{snapshot, too_busy};
use super::status::{self, StatusPage};
use crate::shared::http::paths::{self, GET, READ, path};
use crate::shared::http::websocket;
use crate::shared::http::{CONTENT_TYPE, Kind};
use crate::simulation::client::WebClient;
use crate::simulation::state::AppState;

/// Adds all paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(paths::all(add, "/monitor, /status, /load, /metrics or /health"));
}

fn add(app: &mut web::ServiceConfig) {
    app.service(path("/client", GET, client))
        .service(path("/load", READ, load))
        .configure(page_routes::configure)
        .service(path("/status", READ, status_json))
        .service(path("/metrics", READ, metrics))
        .service(path("/health", READ, health))
        .configure(actions::configure);
}

async fn client(request: HttpRequest, stream: web::Payload, server: web::Data<AppState>) -> HttpResponse {
    if let Some(refusal) = refuse_origin(&request, &server) {
        return refusal;
    }
    let peer = server.config.trusted_proxies.peer(&request);
    let permit = match server.connections.admit(Kind::Client, peer) {
        Ok(permit) => permit,
        Err(refused) => return refused.answer(),
    };
    let user = server.config.user_header.as_ref().and_then(|name| server.config.trusted_proxies.told(&request, name));
    let server = Arc::clone(&server);
    websocket::open(&request, stream, |reader| WebClient::new(server, (peer, user), (permit, reader)))
}

/// A page of another origin may use visitors' browsers to start simulations, unless origins are listed.
fn refuse_origin(request: &HttpRequest, server: &AppState) -> Option<HttpResponse> {
    let allowed = &server.config.allowed_origins;
    let origin = request.headers().get(header::ORIGIN)?.to_str().unwrap_or_default();
    if allowed.is_empty() || allowed.iter().any(|one| one.matches(origin)) {
        return None;
    }
    Some(HttpResponse::Forbidden().body("Error: this page is not one of those that may start simulations here."))
}

async fn load(server: web::Data<AppState>) -> HttpResponse {
    HttpResponse::Ok().content_type("text/plain").body(server.load().to_string())
}

async fn status_json(server: web::Data<AppState>) -> HttpResponse {
    match snapshot(&server).await {
        Some(snapshot) => HttpResponse::Ok().json(StatusPage::new(&server, snapshot)),
        None => too_busy(),
    }
}

async fn metrics(server: web::Data<AppState>) -> HttpResponse {
    let Some(snapshot) = snapshot(&server).await else {
        return too_busy();
    };
    match server.metrics.render(&status::gauges(&server, &snapshot)) {
        Ok(text) => HttpResponse::Ok().content_type(CONTENT_TYPE).body(text),
        Err(error) => HttpResponse::InternalServerError().body(format!("Error: {error}.")),
    }
}

async fn health(server: web::Data<AppState>) -> HttpResponse {
    match server.problem() {
        None => HttpResponse::Ok().content_type("text/plain").body("ok"),
        Some(problem) => {
            HttpResponse::ServiceUnavailable().content_type("text/plain").body(format!("Error: {problem}"))
        }
    }
}
