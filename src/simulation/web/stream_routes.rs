//! The streams of simulations, `/stream/TOKEN/...`: WebSockets, and the files that Webots serves.

use std::sync::Arc;

use actix_web::error::ErrorNotFound;
use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse, web};

use super::access::check_origin;
use crate::shared::http::ConnectionKind;
use crate::shared::http::routing::{GET, path, refuse_body, retry_after};
use crate::simulation::relay::{self, Upstream};
use crate::simulation::state::AppState;

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/stream/{path:.*}", GET, stream));
}

async fn stream(request: HttpRequest, server: web::Data<AppState>) -> actix_web::Result<HttpResponse> {
    let nothing = || ErrorNotFound("Error: there is no such stream.");
    // The path as the client has sent it: what is percent-encoded stays so.
    let (token, path) = relay::parse_path(request.uri().path()).ok_or_else(nothing)?;
    let target = server.slots.stream(token).ok_or_else(nothing)?;
    if let Some(refusal) = refuse_body(&request) {
        return Ok(refusal);
    }
    let headers = request.headers();
    let is_websocket = headers.contains_key(header::UPGRADE);
    // Worlds' pages and Webots' own viewer run in frames without an origin: the token keeps strangers out.
    let is_in_frame = headers.get(header::ORIGIN).is_some_and(|origin| origin == "null");
    if !is_in_frame {
        check_origin(&request, &server.config.allowed_origins)?;
    }
    let peer = server.config.trusted_proxies.peer(&request);
    let permit = server.connections.admit(ConnectionKind::Stream, peer)?;
    let upstream = request.app_data::<Upstream>().ok_or_else(nothing)?;
    let path = request
        .uri()
        .query()
        .map_or(path.to_owned(), |query| format!("{path}?{query}"));
    if !is_websocket {
        return Ok(upstream.fetch(target.port, &path, &request, permit).await);
    }
    let Ok(connection) = Arc::clone(&target.connections).try_acquire_owned() else {
        return Ok(HttpResponse::TooManyRequests()
            .insert_header(retry_after())
            .body("Error: this simulation has too many open streams."));
    };
    let held = (permit, connection);
    if !target.read_only {
        server.slots.viewed(target.simulation);
        return Ok(relay::connect(upstream, target, &path, &request, held).await);
    }
    let watching = server.slots.start_watching(target.simulation, token);
    let guard = watching.ok_or_else(nothing)?;
    log::info!("{}: client {peer} watches", target.simulation);
    Ok(relay::connect(upstream, target, &path, &request, (held, guard)).await)
}
