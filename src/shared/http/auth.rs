//! HTTP basic authentication (RFC 7617) with the administrator's password and any user name, with a rate limit for
//! guesses.

use std::net::Ipv6Addr;
use std::num::NonZeroU32;

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use subtle::ConstantTimeEq;

use super::address_quota::AddressQuota;
use super::peer::Peer;
use super::routing::{reject_cross_site, retry_after};
use crate::shared::config::Secret;

/// Passwords that an address may send in a burst: 30.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(29);
/// Passwords that an address may send per minute after a burst: 12.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(11);

/// Checks the password of requests.
#[derive(Debug)]
pub struct BasicAuth {
    password: Secret,
    attempts: AddressQuota,
}

/// Why a request is refused, as text for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthError {
    /// The request has no password, or a wrong one.
    #[error("Error: a password is needed.")]
    NoPassword,
    /// The client's address has sent too many passwords; this one was not compared.
    #[error("Error: too many passwords from your address.")]
    TooMany,
}

impl BasicAuth {
    /// Creates an authenticator for this password.
    pub fn new(password: Secret) -> Self {
        Self { password, attempts: AddressQuota::new(BURST, PER_MINUTE) }
    }

    /// Checks the password of a request, in constant time. Right passwords count as attempts too, so that a client over
    /// the limit does not learn which one is right.
    ///
    /// # Errors
    /// When the password is missing or wrong, or `peer` has sent too many.
    pub fn check(&self, request: &HttpRequest, peer: Peer) -> Result<(), AuthError> {
        let given = password_of(request).ok_or(AuthError::NoPassword)?;
        if !self.may_try(peer) {
            return Err(AuthError::TooMany);
        }
        if given.as_bytes().ct_eq(self.password.reveal().as_bytes()).into() {
            return Ok(());
        }
        log::warn!("client {peer}: a wrong administrator password");
        Err(AuthError::NoPassword)
    }

    /// Whether a client may send one more password. A proxy that does not report client addresses shares one quota with all
    /// such proxies. While too many addresses are tracked, others may send none.
    fn may_try(&self, peer: Peer) -> bool {
        self.attempts.check(peer.rate_limit_key().unwrap_or(Ipv6Addr::UNSPECIFIED.into())) == Some(true)
    }
}

/// Refuses a request for an action unless it brings the password and no page of another site has made it. Without a
/// password in the configuration there are no actions.
pub fn refuse_action(auth: Option<&BasicAuth>, request: &HttpRequest, peer: Peer) -> Option<HttpResponse> {
    reject_cross_site(request).or_else(|| require_administrator(auth, request, peer))
}

/// Refuses a request without the administrator's password, and every request if there is none in the configuration.
pub fn require_administrator(auth: Option<&BasicAuth>, request: &HttpRequest, peer: Peer) -> Option<HttpResponse> {
    let Some(auth) = auth else {
        return Some(HttpResponse::Forbidden().body("Error: actions are off; adminPassword is not set."));
    };
    auth.check(request, peer).err().map(AuthError::answer)
}

/// The password that a request brings, with whatever user name.
fn password_of(request: &HttpRequest) -> Option<String> {
    let (scheme, credentials) = request.headers().get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let text = String::from_utf8(BASE64_STANDARD.decode(credentials.trim()).ok()?).ok()?;
    text.split_once(':').map(|(_, password)| password.to_owned())
}

impl AuthError {
    /// The response to a refused request.
    pub fn answer(self) -> HttpResponse {
        match self {
            Self::NoPassword => HttpResponse::Unauthorized()
                .insert_header((header::WWW_AUTHENTICATE, "Basic realm=\"administrator\""))
                .body(self.to_string()),
            Self::TooMany => HttpResponse::TooManyRequests().insert_header(retry_after()).body(self.to_string()),
        }
    }
}

impl actix_web::ResponseError for AuthError {
    fn error_response(&self) -> HttpResponse {
        self.answer()
    }
}

#[cfg(test)]
mod tests {
    use std::net::IpAddr;

    use super::*;

    #[test]
    fn only_so_many_addresses_may_send_passwords() {
        let auth = BasicAuth::new(serde_json::from_str("\"open sesame\"").unwrap());
        let may_try = |number: u32| auth.may_try(Peer::Client(IpAddr::from((number << 8).to_be_bytes())));
        let tried: Vec<bool> = (0..20_000).map(may_try).collect();
        let limit = tried.iter().position(|may| !may).unwrap();
        assert!((1_000..20_000).contains(&limit) && !tried[limit..].contains(&true), "{limit}");
    }
}
