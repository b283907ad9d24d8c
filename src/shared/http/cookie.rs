//! What a browser keeps of an administrator's sign-in: a cookie, signed, so that no server has to keep it.
//!
//! The same text in a URL leads the browser from the session server to another server of the fleet, for a minute.

use actix_web::HttpRequest;
use actix_web::http::header;
use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;

use crate::shared::domain::{FleetKey, Purpose, SIGNATURE, ServerRun};

/// An administrator's sign-in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignIn {
    /// The name that the administrator has given, for the log; it may be empty.
    pub name: String,
    /// A random number, by which the browser is known after the end of its sign-in.
    pub browser: u64,
    /// When it ends, in seconds since 1970; 0 after it was ended.
    pub until: u64,
}

/// What a text of a sign-in is for.
#[derive(Debug, Clone, Copy)]
pub enum Use<'password> {
    /// A cookie of a server with this password. It is not valid any more after the password has changed.
    Cookie(&'password str),
    /// A way for a browser to this run of a simulation server. No other server takes it.
    Entry(ServerRun),
    /// To read something from another server of the fleet. It signs no browser in.
    Reading,
}

/// Length of a number, in bytes.
const NUMBER: usize = size_of::<u64>();
/// Longest name, in characters.
const MAX_NAME: usize = 60;

impl SignIn {
    /// The text, for a browser.
    pub fn write(&self, key: &FleetKey, purpose: Use) -> String {
        let mut bytes = [self.browser, self.until].map(u64::to_be_bytes).as_flattened().to_vec();
        bytes.extend(self.name.chars().take(MAX_NAME).collect::<String>().as_bytes());
        let signature = purpose.sign(key, &bytes);
        bytes.extend(signature);
        URL_SAFE_NO_PAD.encode(bytes)
    }

    /// Reads a text; `None` if it was not signed with this key for this purpose.
    pub fn read(text: &str, key: &FleetKey, purpose: Use) -> Option<Self> {
        let bytes = URL_SAFE_NO_PAD.decode(text).ok()?;
        let (content, signature) = bytes.split_at_checked(bytes.len().checked_sub(SIGNATURE)?)?;
        if !purpose.verifies(key, content, signature) {
            return None;
        }
        let (browser, rest) = content.split_at_checked(NUMBER)?;
        let (until, name) = rest.split_at_checked(NUMBER)?;
        Some(Self {
            name: String::from_utf8(name.to_vec()).ok()?,
            browser: u64::from_be_bytes(browser.try_into().ok()?),
            until: u64::from_be_bytes(until.try_into().ok()?),
        })
    }

    /// Whether it holds at this time, in seconds since 1970.
    pub fn holds(&self, now: u64) -> bool {
        now < self.until
    }
}

impl Use<'_> {
    fn sign(self, key: &FleetKey, content: &[u8]) -> [u8; SIGNATURE] {
        match self {
            Self::Cookie(password) => key.sign(Purpose::SignIn, &[content, password.as_bytes()]),
            Self::Entry(server) => key.sign(Purpose::Entry, &[content, &server.0.to_be_bytes()]),
            Self::Reading => key.sign(Purpose::Reading, &[content]),
        }
    }

    fn verifies(self, key: &FleetKey, content: &[u8], signature: &[u8]) -> bool {
        match self {
            Self::Cookie(password) => key.verifies(Purpose::SignIn, &[content, password.as_bytes()], signature),
            Self::Entry(server) => key.verifies(Purpose::Entry, &[content, &server.0.to_be_bytes()], signature),
            Self::Reading => key.verifies(Purpose::Reading, &[content], signature),
        }
    }
}

/// The values of a request's cookies of this name (RFC 6265, section 4.2).
pub fn cookies<'request>(request: &'request HttpRequest, name: &str) -> impl Iterator<Item = &'request str> {
    let headers = request.headers().get_all(header::COOKIE);
    let pairs = headers
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'));
    pairs.filter_map(move |pair| {
        let (one, value) = pair.trim().split_once('=')?;
        (one == name).then_some(value)
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn anna() -> SignIn {
        SignIn {
            name: "Anna".to_owned(),
            browser: 7,
            until: 1000,
        }
    }

    #[test]
    fn a_sign_in_is_valid_for_its_key_password_and_purpose() {
        let key = FleetKey::new("a secret of a fleet");
        let text = anna().write(&key, Use::Cookie("open sesame"));
        assert_eq!(SignIn::read(&text, &key, Use::Cookie("open sesame")), Some(anna()));
        assert!(anna().holds(999) && !anna().holds(1000));
        assert_eq!(SignIn::read(&text, &key, Use::Cookie("another")), None);
        assert_eq!(
            SignIn::read(&text, &FleetKey::random(), Use::Cookie("open sesame")),
            None
        );
        let here = Use::Entry(ServerRun(1));
        assert_eq!(SignIn::read(&text, &key, here), None);
        let entry = anna().write(&key, here);
        assert_eq!(SignIn::read(&entry, &key, here), Some(anna()));
        assert_eq!(SignIn::read(&entry, &key, Use::Entry(ServerRun(2))), None);
        assert_eq!(SignIn::read(&entry, &key, Use::Cookie("")), None);
        assert_eq!(SignIn::read(&entry, &key, Use::Reading), None);
    }

    proptest! {
        #[test]
        fn any_text_is_read(text: String) {
            prop_assert_eq!(SignIn::read(&text, &FleetKey::random(), Use::Reading), None);
        }

        #[test]
        fn any_name_is_kept(name in ".{0,60}") {
            let key = FleetKey::random();
            let one = SignIn { name, ..anna() };
            prop_assert_eq!(SignIn::read(&one.write(&key, Use::Reading), &key, Use::Reading), Some(one));
        }
    }
}
