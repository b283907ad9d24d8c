//! The administrator's password: HTTP basic authentication (RFC 7617), any user name.

use actix_web::HttpRequest;
use actix_web::http::header::Header;
use actix_web_httpauth::headers::authorization::{Authorization, Basic};
use constant_time_eq::constant_time_eq;

use super::config_value::Secret;

/// Whether a request carries this password. How long the answer takes tells nothing of it.
#[must_use]
pub fn is_authorised(request: &HttpRequest, password: &Secret) -> bool {
    let given = Authorization::<Basic>::parse(request).map(Authorization::into_scheme);
    given.is_ok_and(|given| {
        given.password().is_some_and(|given| constant_time_eq(given.as_bytes(), password.reveal().as_bytes()))
    })
}
