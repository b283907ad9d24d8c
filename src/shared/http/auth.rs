//! HTTP basic authentication (RFC 7617) with the administrator's password and any user name, with a rate limit for
//! guesses.

use std::net::Ipv6Addr;

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use subtle::ConstantTimeEq;

use super::limits::AddressQuota;
use super::peer::Peer;
use super::routing::retry_after;
use crate::shared::config::Secret;

/// Checks the password of requests.
#[derive(Debug)]
pub struct BasicAuth {
    password: Secret,
    failures: AddressQuota,
}

/// Why a request is refused, as text for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthError {
    /// The request has no password, or a wrong one.
    #[error("Error: a password is needed.")]
    NoPassword,
    /// The client's address has sent too many wrong passwords; this one was not compared.
    #[error("Error: too many wrong passwords from your address.")]
    TooMany,
}

impl BasicAuth {
    /// Creates an authenticator for this password.
    pub fn new(password: Secret) -> Self {
        // Thirty wrong passwords at once, and twelve a minute.
        Self {
            password,
            failures: AddressQuota::new(30, 12),
        }
    }

    /// Checks the password of a request, in constant time. Only wrong passwords count. Over the limit the password is not
    /// compared, so that a client that guesses does not learn which one is right.
    ///
    /// # Errors
    /// When the password is missing or wrong, or `peer` has sent too many wrong ones.
    pub fn check(&self, request: &HttpRequest, peer: Peer) -> Result<(), AuthError> {
        let given = password_of(request).ok_or(AuthError::NoPassword)?;
        // Proxies that don't report client addresses share one quota.
        let address = Some(peer.rate_limit_key().unwrap_or(Ipv6Addr::UNSPECIFIED.into()));
        // Taken before the comparison: requests that arrive together must not all be compared.
        if !self.failures.take(address) {
            return Err(AuthError::TooMany);
        }
        if given.as_bytes().ct_eq(self.password.reveal().as_bytes()).into() {
            self.failures.give_back(address);
            return Ok(());
        }
        log::warn!("client {peer}: a wrong administrator password");
        Err(AuthError::NoPassword)
    }
}

/// Refuses a request for an action without the password, or from a page of another site (CSRF), to which the browser
/// would add the stored password. Without a password in the configuration all actions are refused.
pub fn refuse_action(auth: Option<&BasicAuth>, request: &HttpRequest, peer: Peer) -> Option<HttpResponse> {
    if is_cross_site(request) {
        return Some(HttpResponse::Forbidden().body("Error: this request comes from a page of another site."));
    }
    require_administrator(auth, request, peer)
}

/// Whether a page of another site has sent a request. Browsers send the page's `Origin`; other programs send none.
fn is_cross_site(request: &HttpRequest) -> bool {
    let header = |name| {
        request
            .headers()
            .get(name)
            .map(|value| value.to_str().unwrap_or_default())
    };
    let host = header(header::HOST).unwrap_or_default();
    header(header::ORIGIN).is_some_and(|origin| {
        let of_page = origin.split_once("://").map_or(origin, |(_, authority)| authority);
        !of_page.eq_ignore_ascii_case(host)
    })
}

/// Refuses a request without the administrator's password, and every request if there is none in the configuration.
pub fn require_administrator(auth: Option<&BasicAuth>, request: &HttpRequest, peer: Peer) -> Option<HttpResponse> {
    let Some(auth) = auth else {
        return Some(HttpResponse::Forbidden().body("Error: actions are off; adminPassword is not set."));
    };
    auth.check(request, peer).err().map(HttpResponse::from_error)
}

/// The password of a request; the user name is ignored.
fn password_of(request: &HttpRequest) -> Option<String> {
    let (scheme, credentials) = request
        .headers()
        .get(header::AUTHORIZATION)?
        .to_str()
        .ok()?
        .split_once(' ')?;
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let text = String::from_utf8(BASE64_STANDARD.decode(credentials.trim()).ok()?).ok()?;
    text.split_once(':').map(|(_, password)| password.to_owned())
}

impl actix_web::ResponseError for AuthError {
    fn error_response(&self) -> HttpResponse {
        match self {
            Self::NoPassword => HttpResponse::Unauthorized()
                .insert_header((header::WWW_AUTHENTICATE, "Basic realm=\"administrator\""))
                .body(self.to_string()),
            Self::TooMany => HttpResponse::TooManyRequests()
                .insert_header(retry_after())
                .body(self.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use actix_web::test::TestRequest;

    use super::*;

    #[test]
    fn only_pages_of_the_same_site_change_something() {
        let request = || TestRequest::post().insert_header((header::HOST, "lab.org:2000"));
        assert!(!is_cross_site(&request().to_http_request()));
        for (origin, is_other) in [
            ("https://lab.org:2000", false),
            ("http://LAB.org:2000", false),
            ("https://lab.org", true),
            ("https://lab.org:2000.evil.example", true),
            ("null", true),
        ] {
            let request = request().insert_header((header::ORIGIN, origin)).to_http_request();
            assert_eq!(is_cross_site(&request), is_other, "{origin}");
        }
    }
}
