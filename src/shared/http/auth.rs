//! The administrator's password: HTTP basic authentication (RFC 7617), any user name. It can't be guessed at as fast as
//! a client likes.

use std::net::IpAddr;
use std::num::NonZeroU32;

use actix_web::http::header::{self, Header};
use actix_web::{HttpRequest, HttpResponse};
use actix_web_httpauth::headers::authorization::{Authorization, Basic};
use constant_time_eq::constant_time_eq;
use governor::clock::DefaultClock;
use governor::state::keyed::HashMapStateStore;
use governor::{Quota, RateLimiter};

use super::paths::come_back;
use super::peer::Peer;
use crate::shared::config::Secret;

/// How many passwords an address may send at once: 30.
const AT_ONCE: NonZeroU32 = NonZeroU32::MIN.saturating_add(29);
/// And in each minute after that: 12.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(11);
/// Of so many addresses is it known how many passwords they have sent lately. Nobody else may send one then.
const MOST_ADDRESSES: usize = 10_000;

/// The password, and who has tried it lately.
#[derive(Debug)]
pub struct Lock {
    password: Secret,
    attempts: RateLimiter<Option<IpAddr>, HashMapStateStore<Option<IpAddr>>, DefaultClock>,
}

/// Why somebody is not let in. The words are for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Locked {
    /// There is no password, or a wrong one.
    #[error("Error: a password is needed.")]
    NoPassword,
    /// Too many passwords were sent: this one was not looked at.
    #[error("Error: too many passwords from your address.")]
    TooMany,
}

impl Lock {
    /// A lock with this password.
    #[must_use]
    pub fn new(password: Secret) -> Self {
        Self { password, attempts: RateLimiter::hashmap(Quota::per_minute(PER_MINUTE).allow_burst(AT_ONCE)) }
    }

    /// Whether a request carries the password. How long the answer takes tells nothing of it. Right ones count as
    /// attempts too: who has used up all attempts does not learn which one is right.
    ///
    /// # Errors
    /// When it doesn't, or `peer` has tried too often.
    pub fn admit(&self, request: &HttpRequest, peer: Peer) -> Result<(), Locked> {
        let given = Authorization::<Basic>::parse(request).map(Authorization::into_scheme);
        let given = given.map_err(|_| Locked::NoPassword)?;
        let given = given.password().ok_or(Locked::NoPassword)?;
        // A proxy that says nothing of its clients stands for all of them.
        if !self.may_try(peer.household()) {
            return Err(Locked::TooMany);
        }
        if constant_time_eq(given.as_bytes(), self.password.reveal().as_bytes()) {
            return Ok(());
        }
        log::warn!("client {peer}: a wrong administrator password");
        Err(Locked::NoPassword)
    }

    fn may_try(&self, from: Option<IpAddr>) -> bool {
        if self.attempts.len() >= MOST_ADDRESSES {
            self.attempts.retain_recent();
        }
        self.attempts.len() < MOST_ADDRESSES && self.attempts.check_key(&from).is_ok()
    }
}

impl Locked {
    /// The answer to whoever is not let in.
    #[must_use]
    pub fn answer(self) -> HttpResponse {
        match self {
            Self::NoPassword => HttpResponse::Unauthorized()
                .insert_header((header::WWW_AUTHENTICATE, "Basic realm=\"simulation server\""))
                .body(self.to_string()),
            Self::TooMany => HttpResponse::TooManyRequests().insert_header(come_back()).body(self.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_are_counted_for_each_address_and_of_so_many_addresses_only() {
        let lock = Lock::new(serde_json::from_str("\"open sesame\"").unwrap());
        let address = |number: usize| Some(IpAddr::from(u32::try_from(number).unwrap().to_be_bytes()));
        for _ in 0..AT_ONCE.get() {
            assert!(lock.may_try(address(0)));
        }
        assert!(!lock.may_try(address(0)));
        for number in 1..MOST_ADDRESSES + 9 {
            assert_eq!(lock.may_try(address(number)), number < MOST_ADDRESSES, "{number}");
        }
        assert!(lock.attempts.len() <= MOST_ADDRESSES);
    }
}
