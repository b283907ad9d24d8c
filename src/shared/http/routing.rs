//! What the routes of both servers share: allowed methods, CORS headers, bodies of requests, the answer for unknown paths.
//! Only requests for actions may have a body, which is small, has a `Content-Length` and must arrive in time.

use std::time::Duration;

use actix_web::dev::HttpServiceFactory;
use actix_web::http::header::{self, HeaderName, HeaderValue};
use actix_web::http::{Method, StatusCode};
use actix_web::middleware::DefaultHeaders;
use actix_web::web::{Bytes, Payload};
use actix_web::{FromRequest, Handler, HttpRequest, HttpResponse, Resource, Responder, guard, web};
use rand::RngExt;
use serde::de::DeserializeOwned;

/// Range of `Retry-After`, in seconds.
const RETRY_AFTER: std::ops::RangeInclusive<u16> = 2..=6;

/// Size limit of a body, in bytes. A larger or chunked body is not read.
pub const MAX_BODY: usize = 8 * 1024;
/// Timeout of a body.
const BODY_TIMEOUT: Duration = Duration::from_secs(5);

/// For reads. Monitoring programs often request the head alone (RFC 9110, section 9.3.2).
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
    HttpResponse::MethodNotAllowed()
        .insert_header((header::ALLOW, allowed))
        .body(words)
}

/// The header `Retry-After`, in seconds. Random, so that clients that are refused together do not retry together.
pub fn retry_after() -> (HeaderName, HeaderValue) {
    (
        header::RETRY_AFTER,
        HeaderValue::from(rand::rng().random_range(RETRY_AFTER)),
    )
}

/// Refuses a request that has a body, for routes that read none.
pub fn refuse_body(request: &HttpRequest) -> Option<HttpResponse> {
    let headers = request.headers();
    let has_length = headers.get(header::CONTENT_LENGTH).is_some_and(|length| length != "0");
    let has_body = has_length || headers.contains_key(header::TRANSFER_ENCODING);
    has_body.then(|| HttpResponse::BadRequest().body("Error: a request for this has no body."))
}

/// Reads the JSON of a body; an empty one is the default. `form` is the expected form, for the error message.
///
/// # Errors
/// The answer to a request whose body can't be read.
pub async fn json_body<T: DeserializeOwned + Default>(
    request: &HttpRequest,
    payload: Payload,
    form: &str,
) -> Result<T, HttpResponse> {
    let body = body(request, payload).await?;
    if body.is_empty() {
        return Ok(T::default());
    }
    serde_json::from_slice(&body)
        .map_err(|_| HttpResponse::BadRequest().body(format!("Error: the body is not {form}.")))
}

/// Reads a body.
///
/// # Errors
/// The answer to a request whose body can't be read.
pub async fn body(request: &HttpRequest, payload: Payload) -> Result<Bytes, HttpResponse> {
    let headers = request.headers();
    let length = headers
        .get(header::CONTENT_LENGTH)
        .and_then(|length| length.to_str().ok()?.parse().ok());
    if headers.contains_key(header::TRANSFER_ENCODING) || length.is_some_and(|length: usize| length > MAX_BODY) {
        let words = format!("Error: a body has a Content-Length of at most {MAX_BODY} bytes.");
        return Err(HttpResponse::PayloadTooLarge().force_close().body(words));
    }
    let read = actix_web::rt::time::timeout(BODY_TIMEOUT, payload.to_bytes_limited(MAX_BODY)).await;
    match read {
        Ok(Ok(Ok(body))) => Ok(body),
        Ok(_) => Err(HttpResponse::BadRequest().body("Error: the body can't be read.")),
        Err(_) => Err(HttpResponse::RequestTimeout()
            .force_close()
            .body("Error: the body did not come in time.")),
    }
}

/// All routes of a server, usable by pages of any origin; `hint` lists the usual paths for the 404 page.
pub fn all(configure: fn(&mut web::ServiceConfig), hint: &'static str) -> impl HttpServiceFactory + 'static {
    let headers = DefaultHeaders::new()
        .add((header::ACCESS_CONTROL_ALLOW_ORIGIN, "*"))
        .add((header::ACCESS_CONTROL_ALLOW_HEADERS, "x-requested-with"))
        .add((header::ACCESS_CONTROL_ALLOW_METHODS, "POST, GET, OPTIONS"))
        .add((header::ACCESS_CONTROL_EXPOSE_HEADERS, "Retry-After, Webots-Reason"))
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
