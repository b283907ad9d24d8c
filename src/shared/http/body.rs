//! The bodies of requests: of actions they are small, of a known length and in time; other requests have none.

use std::time::Duration;

use actix_web::http::header;
use actix_web::web::Payload;
use actix_web::{HttpRequest, HttpResponse};
use serde::de::DeserializeOwned;

use super::client_stream::MAX_BODY;

/// Timeout of a body.
const BODY_TIMEOUT: Duration = Duration::from_secs(5);

/// Refuses a request with a body where none is read.
pub fn refuse(request: &HttpRequest) -> Option<HttpResponse> {
    let headers = request.headers();
    let has_length = headers.get(header::CONTENT_LENGTH).is_some_and(|length| length != "0");
    let has_body = has_length || headers.contains_key(header::TRANSFER_ENCODING);
    has_body.then(|| HttpResponse::BadRequest().body("Error: a request for this has no body."))
}

/// Reads the JSON of a body; an empty one is the default. `form` is the expected form, for the error message.
///
/// # Errors
/// The answer to a request whose body can't be read.
pub async fn json<T: DeserializeOwned + Default>(
    request: &HttpRequest,
    payload: Payload,
    form: &str,
) -> Result<T, HttpResponse> {
    let headers = request.headers();
    let length = headers.get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    if headers.contains_key(header::TRANSFER_ENCODING) || length.is_some_and(|length: usize| length > MAX_BODY) {
        let words = format!("Error: a body has a Content-Length of at most {MAX_BODY} bytes.");
        return Err(HttpResponse::PayloadTooLarge().force_close().body(words));
    }
    let wrong = || HttpResponse::BadRequest().body(format!("Error: the body is not {form}."));
    let read = actix_web::rt::time::timeout(BODY_TIMEOUT, payload.to_bytes_limited(MAX_BODY)).await;
    match read {
        Ok(Ok(Ok(body))) if body.is_empty() => Ok(T::default()),
        Ok(Ok(Ok(body))) => serde_json::from_slice(&body).map_err(|_| wrong()),
        Ok(_) => Err(wrong()),
        Err(_) => Err(HttpResponse::RequestTimeout().force_close().body("Error: the body did not come in time.")),
    }
}
