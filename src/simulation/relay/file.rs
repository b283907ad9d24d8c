//! A file that Webots serves, or its video.

use actix_web::http::StatusCode;
use actix_web::http::header::{self, HeaderName};
use actix_web::{HttpRequest, HttpResponse};
use futures_util::StreamExt;

use super::upstream::{ANSWER_TIMEOUT, Upstream};

/// Headers of Webots' answer that its client gets.
const FORWARDED_HEADERS: [HeaderName; 4] =
    [header::CONTENT_TYPE, header::ETAG, header::CACHE_CONTROL, header::LAST_MODIFIED];

/// Fetches a file of Webots, and forwards the answer as fast as the client reads it. `held` is dropped with the answer.
pub async fn fetch(upstream: &Upstream, url: &str, request: &HttpRequest, held: impl std::any::Any) -> HttpResponse {
    // A connection that is kept could lead to another simulation on the same port later.
    // Webots compares the names of headers letter by letter (WbTcpServer.cpp of R2025a).
    let mut query = upstream.client.get(url).no_decompress().force_close().camel_case();
    if let Some(tag) = request.headers().get(header::IF_NONE_MATCH) {
        query = query.insert_header((header::IF_NONE_MATCH, tag));
    }
    let answer = match actix_rt::time::timeout(ANSWER_TIMEOUT, query.send()).await {
        Ok(Ok(answer)) if !answer.status().is_informational() => answer,
        Ok(_) => return HttpResponse::BadGateway().body("Error: the simulation does not answer."),
        Err(_) => return HttpResponse::GatewayTimeout().body("Error: the simulation does not answer."),
    };
    let mut response = HttpResponse::build(answer.status());
    for name in FORWARDED_HEADERS {
        if let Some(value) = answer.headers().get(&name) {
            response.insert_header((name, value));
        }
    }
    // The content is made by worlds: it gets an origin of its own, so that it can't act as a page of this server, and no
    // referrer, because its URL has the token.
    response.insert_header((header::CONTENT_SECURITY_POLICY, "sandbox allow-scripts"));
    response.insert_header((header::REFERRER_POLICY, "no-referrer"));
    if matches!(answer.status(), StatusCode::NO_CONTENT | StatusCode::NOT_MODIFIED) {
        return response.finish();
    }
    let length = answer.headers().get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    if let Some(length) = length {
        response.no_chunking(length);
    }
    response.streaming(answer.map(move |part| {
        let _ = &held;
        part
    }))
}
