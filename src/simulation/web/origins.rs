//! From which pages browsers may use simulations.

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse};

use crate::shared::http::Origin;

/// A page of another origin may use visitors' browsers to start simulations, unless origins are listed.
pub fn refuse_origin(request: &HttpRequest, allowed: &[Origin]) -> Option<HttpResponse> {
    let origin = request.headers().get(header::ORIGIN)?.to_str().unwrap_or_default();
    if allowed.is_empty() || allowed.iter().any(|one| one.matches(origin)) {
        return None;
    }
    Some(HttpResponse::Forbidden().body("Error: this page is not one of those that may start simulations here."))
}
