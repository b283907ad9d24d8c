//! What the routes of both servers share: allowed methods, CORS headers, the answer for unknown paths.

use actix_web::dev::HttpServiceFactory;
use actix_web::http::header::{self, HeaderName, HeaderValue};
use actix_web::http::{Method, StatusCode};
use actix_web::middleware::DefaultHeaders;
use actix_web::{FromRequest, Handler, HttpResponse, Resource, Responder, guard, web};
use rand::RngExt;

/// Range of `Retry-After`, in seconds.
const RETRY_AFTER: std::ops::RangeInclusive<u16> = 2..=6;

/// For reads. Monitoring programs like to request the head alone (RFC 9110, section 9.3.2).
pub const READ: &[Method] = &[Method::GET, Method::HEAD];
/// For WebSockets and event streams, whose answers are unbounded.
pub const GET: &[Method] = &[Method::GET];
/// For requests that change state.
pub const POST: &[Method] = &[Method::POST];

/// A route with these methods. Other methods get 405 with the allowed ones (RFC 9110, section 15.5.6), and OPTIONS is
/// answered.
pub fn path<F, Arguments>(name: &str, methods: &'static [Method], handler: F) -> Resource
where
    F: Handler<Arguments, Output: Responder + 'static>,
    Arguments: FromRequest + 'static,
{
    let route = web::route().guard(guard::fn_guard(move |request| methods.contains(&request.head().method)));
    web::resource(name)
        .route(route.to(handler))
        .route(web::method(Method::OPTIONS).to(HttpResponse::NoContent))
        .default_service(web::to(move || async move { wrong_method(methods) }))
}

fn wrong_method(methods: &[Method]) -> HttpResponse {
    let allowed = methods.iter().map(Method::as_str).collect::<Vec<_>>().join(", ");
    let words = format!("Error: wrong method; allowed here: {allowed}.");
    HttpResponse::MethodNotAllowed().insert_header((header::ALLOW, allowed)).body(words)
}

/// The header `Retry-After`, in seconds. Random, so that a class that was refused at once does not retry at once.
pub fn retry_after() -> (HeaderName, HeaderValue) {
    (header::RETRY_AFTER, HeaderValue::from(rand::rng().random_range(RETRY_AFTER)))
}

/// All routes of a server, usable by pages of any origin; `hint` lists the usual paths for the 404 page.
pub fn all(configure: fn(&mut web::ServiceConfig), hint: &'static str) -> impl HttpServiceFactory + 'static {
    let headers = DefaultHeaders::new()
        .add((header::ACCESS_CONTROL_ALLOW_ORIGIN, "*"))
        .add((header::ACCESS_CONTROL_ALLOW_HEADERS, "x-requested-with"))
        .add((header::ACCESS_CONTROL_ALLOW_METHODS, "POST, GET, OPTIONS"))
        .add((header::ACCESS_CONTROL_EXPOSE_HEADERS, "Retry-After"))
        .add((header::CACHE_CONTROL, "no-store"))
        .add((header::X_CONTENT_TYPE_OPTIONS, "nosniff"));
    web::scope("")
        .wrap(headers)
        .configure(configure)
        .route("/{path:.*}", web::method(Method::OPTIONS).to(HttpResponse::NoContent))
        .default_service(web::to(move || async move {
            let words = format!("Error: there is nothing here. Try {hint}.");
            HttpResponse::build(StatusCode::NOT_FOUND).body(words)
        }))
}
