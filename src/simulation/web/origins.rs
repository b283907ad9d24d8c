//! From which pages browsers may use simulations.

use actix_web::HttpRequest;
use actix_web::error::ErrorForbidden;
use actix_web::http::header;

use crate::shared::http::Origin;

/// A page of another origin may use visitors' browsers to start simulations, unless origins are listed.
///
/// # Errors
/// The response to the request of a page that may not.
pub fn check_origin(request: &HttpRequest, allowed: &[Origin]) -> actix_web::Result<()> {
    let Some(origin) = request.headers().get(header::ORIGIN) else { return Ok(()) };
    let origin = origin.to_str().unwrap_or_default();
    if allowed.is_empty() || allowed.iter().any(|one| one.0 == origin) {
        return Ok(());
    }
    Err(ErrorForbidden("Error: this page is not one of those that may start simulations here."))
}
