//! The session server's routes: each parses the request, queries the registry, and maps the answer.

use std::borrow::Cow;
use std::sync::Arc;

use actix_web::error::ErrorInternalServerError;
use actix_web::http::{StatusCode, header};
use actix_web::{HttpRequest, HttpResponse, Result, web};
use jiff::Timestamp;
use percent_encoding::percent_decode_str;
use serde::Deserialize;

use super::refusal;
use super::status::status_page;
use super::web_client::WebClient;
use super::{class_routes, metrics, page_routes};
use crate::session::state::AppState;
use crate::shared::domain::{ReadyEntry, Reason};
use crate::shared::http::routing::{self, GET, POST, READ, body, json_body, path, retry_after};
use crate::shared::http::{CONTENT_TYPE, ConnectionKind, openapi, sign_in, websocket};
use crate::shared::text::one_line;

/// The body of `POST /announcement`.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Announcement {
    text: String,
}

/// The content type of an answer of `/session`.
const TEXT: &str = "text/plain; charset=utf-8";
/// Longest announcement, in characters.
const MAX_ANNOUNCEMENT: usize = 300;

/// Adds all routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(routing::all(
        add,
        "/session, /monitor, /viewer, /status, /load, /metrics or /health",
    ));
}

fn add(app: &mut web::ServiceConfig) {
    app.service(path("/", GET, root))
        .service(path("/request", READ, availability))
        .service(path("/session", GET, session))
        .service(path("/load", READ, load))
        .configure(page_routes::configure)
        .configure(sign_in::configure)
        .configure(class_routes::configure)
        .configure(openapi::configure)
        .service(path("/status", READ, status_json))
        .service(path("/metrics", READ, metrics_text))
        .service(path("/health", READ, health))
        .service(path("/announcement", POST, announcement))
        .service(path("/ready", POST, ready));
}

fn wants_websocket(request: &HttpRequest) -> bool {
    let upgrade = request
        .headers()
        .get(header::UPGRADE)
        .and_then(|value| value.to_str().ok());
    upgrade.is_some_and(|value| value.eq_ignore_ascii_case("websocket"))
}

async fn root(request: HttpRequest, stream: web::Payload, server: web::Data<AppState>) -> Result<HttpResponse> {
    if wants_websocket(&request) {
        open_websocket(&request, stream, &server)
    } else {
        Ok(availability(server).await)
    }
}

async fn session(request: HttpRequest, stream: web::Payload, server: web::Data<AppState>) -> Result<HttpResponse> {
    if wants_websocket(&request) {
        return open_websocket(&request, stream, &server);
    }
    let from = server.config.trusted_proxies.peer(&request).rate_limit_key();
    let world = wanted_world(request.query_string());
    let failure = match server.pick(world.as_deref(), from).await {
        Ok(url) => return Ok(HttpResponse::Ok().content_type(TEXT).body(url)),
        Err(failure) => failure,
    };
    // Without a world, as the Python server answers: clients such as PHP's `file_get_contents` read no body with another
    // status.
    let status = world.map_or(StatusCode::OK, |_| refusal::status(failure.reason));
    let mut response = HttpResponse::build(status);
    if status == StatusCode::SERVICE_UNAVAILABLE {
        response.insert_header(retry_after());
    }
    response.insert_header((Reason::HEADER, failure.reason.code()));
    Ok(response.content_type(TEXT).body(refusal::sentence(&failure)))
}

/// The world of a query. `webots.js` does not percent-encode it, so everything after `url=` is the world: a plus sign
/// or an ampersand may be part of it. Other clients encode it as usual in queries; then it contains no `:`.
fn wanted_world(query: &str) -> Option<Cow<'_, str>> {
    let begin = query
        .strip_prefix("url=")
        .or_else(|| query.split_once("&url=").map(|(_, world)| world));
    let world = begin.filter(|world| !world.is_empty())?;
    if world.contains(':') {
        return Some(Cow::Borrowed(world));
    }
    let whole = world.split_once('&').map_or(world, |(whole, _)| whole);
    Some(percent_decode_str(whole).decode_utf8_lossy())
}

fn open_websocket(request: &HttpRequest, stream: web::Payload, server: &web::Data<AppState>) -> Result<HttpResponse> {
    let peer = server.config.trusted_proxies.peer(request);
    let permit = server.connections.admit(ConnectionKind::Client, peer)?;
    let user_header = server.config.user_header.as_ref();
    let user = user_header.and_then(|name| server.config.trusted_proxies.user(request, name));
    let server = Arc::clone(server);
    // Pages that do not request announcements would not understand them.
    let wants_announcements = request.query_string().split('&').any(|one| one == "announcements=1");
    Ok(websocket::open(
        request,
        stream,
        WebClient::new(server, (peer, user), wants_announcements, permit),
    ))
}

async fn availability(server: web::Data<AppState>) -> HttpResponse {
    let available = *server.available.borrow();
    HttpResponse::Ok()
        .content_type("text/plain")
        .body(if available { "1" } else { "0" })
}

async fn load(server: web::Data<AppState>) -> HttpResponse {
    let load = server
        .status()
        .await
        .ok()
        .and_then(|status| status.mean_load)
        .unwrap_or(-1.0);
    HttpResponse::Ok().content_type("text/plain").body(load.to_string())
}

async fn status_json(server: web::Data<AppState>) -> Result<HttpResponse> {
    let status = server.status().await?;
    Ok(HttpResponse::Ok().json(status_page(&server, &status)))
}

async fn metrics_text(server: web::Data<AppState>) -> Result<HttpResponse> {
    let status = server.status().await?;
    let text = server.metrics.render(&metrics::gauges(server.clients(), &status));
    let text = text.map_err(|error| ErrorInternalServerError(format!("Error: {error}.")))?;
    Ok(HttpResponse::Ok().content_type(CONTENT_TYPE).body(text))
}

/// Replaces the announcement, which requires the administrator's password; an empty text removes it.
async fn announcement(request: HttpRequest, payload: web::Payload, server: web::Data<AppState>) -> HttpResponse {
    let administrator = match server.admin_auth.actor(&request) {
        Ok(administrator) => administrator,
        Err(error) => return HttpResponse::from_error(error),
    };
    let text = match json_body(&request, payload, "{\"text\": TEXT}").await {
        Ok(Announcement { text }) => one_line(text.trim()),
        Err(refusal) => return refusal,
    };
    if text.chars().count() > MAX_ANNOUNCEMENT {
        let words = format!("Error: an announcement has at most {MAX_ANNOUNCEMENT} letters.");
        return HttpResponse::BadRequest().body(words);
    }
    log::info!("{administrator}: announces {text:?}");
    server.announcement.send_replace(text);
    HttpResponse::Ok().body("ok")
}

/// Asks the fleet to keep simulations of a world ready, which requires the administrator's password.
async fn ready(request: HttpRequest, payload: web::Payload, server: web::Data<AppState>) -> Result<HttpResponse> {
    let administrator = server.admin_auth.actor(&request)?;
    let text = match body(&request, payload).await {
        Ok(text) => text,
        Err(refusal) => return Ok(refusal),
    };
    let entry: ReadyEntry = match serde_json::from_slice(&text) {
        Ok(entry) => entry,
        Err(error) => return Ok(HttpResponse::BadRequest().body(format!("Error: {}.", one_line(&error.to_string())))),
    };
    if entry.until.is_none() && entry.count > 0 {
        return Ok(HttpResponse::BadRequest().body("Error: until is missing, so that nothing is kept ready for ever."));
    }
    if entry.count > 0 && entry.is_over(Timestamp::now()) {
        return Ok(HttpResponse::BadRequest().body("Error: until is over already."));
    }
    log::info!(
        "{administrator}: asks for {} of {} to be kept ready",
        entry.count,
        entry.world
    );
    match server.ready_requests.add(entry).await {
        Ok(()) => Ok(HttpResponse::Ok().body("ok")),
        Err(why) => Ok(HttpResponse::InternalServerError().body(format!("Error: {why}."))),
    }
}

async fn health() -> HttpResponse {
    HttpResponse::Ok().content_type("text/plain").body("ok")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_world_is_all_that_follows_url() {
        let table = [
            ("", None),
            ("url=", None),
            ("mode=x3d", None),
            (
                "url=https://github.com/u/c++/blob/a&b/worlds/x.wbt",
                Some("https://github.com/u/c++/blob/a&b/worlds/x.wbt"),
            ),
            ("mode=x3d&url=https://x", Some("https://x")),
        ];
        for (query, world) in table {
            assert_eq!(wanted_world(query).as_deref(), world, "{query:?}");
        }
    }
}
