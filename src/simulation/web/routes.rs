//! The simulation server's routes: each parses the request, queries what it needs, and maps the answer.

use std::sync::Arc;

use actix_web::error::{ErrorInternalServerError, ErrorNotFound};
use actix_web::{HttpRequest, HttpResponse, web};

use super::access::{Visitor, check_origin};
use super::status::status_page;
use super::{actions, metrics, page_routes, stream_routes};
use crate::shared::http::routing::{self, GET, READ, path};
use crate::shared::http::websocket::MessageLimit;
use crate::shared::http::{CONTENT_TYPE, ConnectionKind, openapi, sign_in, websocket};
use crate::simulation::client::{SlotLink, WebClient};
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::state::AppState;

/// Adds all routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(routing::all(add, "/monitor, /status, /load, /metrics or /health"));
}

fn add(app: &mut web::ServiceConfig) {
    app.service(path("/client", GET, client))
        .service(path("/slots", GET, slots))
        .service(path("/load", READ, load))
        .configure(page_routes::configure)
        .configure(sign_in::configure)
        .configure(openapi::configure)
        .configure(stream_routes::configure)
        .service(path("/status", READ, status_json))
        .service(path("/metrics", READ, metrics_text))
        .service(path("/health", READ, health))
        .configure(actions::configure);
}

async fn client(
    request: HttpRequest,
    stream: web::Payload,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    let config = &server.config;
    let proxies = &server.config.trusted_proxies;
    check_origin(&request, &config.allowed_origins)?;
    let peer = proxies.peer(&request);
    let permit = server.connections.admit(ConnectionKind::Client, peer)?;
    let user = config
        .user_header
        .as_ref()
        .and_then(|name| proxies.user(&request, name));
    let server = Arc::clone(&server);
    Ok(websocket::open(
        &request,
        stream,
        WebClient::new(server, (peer, user), permit),
    ))
}

/// The WebSocket of a session server, in a fleet with a key.
async fn slots(
    request: HttpRequest,
    stream: web::Payload,
    server: web::Data<AppState>,
) -> actix_web::Result<HttpResponse> {
    let key = server.fleet_key.clone();
    let key = key.ok_or_else(|| ErrorNotFound("Error: no slots are reserved here."))?;
    let peer = server.config.trusted_proxies.peer(&request);
    let permit = server.connections.admit(ConnectionKind::Link, peer)?;
    let server = Arc::clone(&server);
    let limit = MessageLimit::default();
    let link = SlotLink::new(server, peer, key, limit.clone(), permit);
    Ok(websocket::open_limited(limit, &request, stream, link))
}

async fn load(server: web::Data<AppState>) -> HttpResponse {
    HttpResponse::Ok()
        .content_type("text/plain")
        .body(server.load_with_slots().to_string())
}

async fn status_json(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let visitor = Visitor::of(&request, &server)?;
    let mut snapshot = server.slots.snapshot();
    for simulation in &mut snapshot.simulations {
        if !visitor.sees_ports(&server.config) {
            simulation.port = None;
        }
        if visitor != Visitor::Administrator {
            simulation.identity = ClientIdentity::default();
        }
        if visitor == Visitor::Stranger {
            simulation.pid = None;
            simulation.log = None;
        }
    }
    let names_machine = visitor != Visitor::Stranger;
    Ok(HttpResponse::Ok().json(status_page(&server, &snapshot, names_machine)))
}

async fn metrics_text(server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let snapshot = server.slots.snapshot();
    let text = server
        .metrics
        .render(&metrics::gauges(&server, &snapshot))
        .map_err(ErrorInternalServerError)?;
    Ok(HttpResponse::Ok().content_type(CONTENT_TYPE).body(text))
}

async fn health(server: web::Data<AppState>) -> HttpResponse {
    match server.problem() {
        None => HttpResponse::Ok().content_type("text/plain").body("ok"),
        Some(problem) => HttpResponse::ServiceUnavailable()
            .content_type("text/plain")
            .body(format!("Error: {problem}")),
    }
}
