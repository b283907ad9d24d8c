//! Whom mail goes to and comes from: `NAME@HOST`, or `Some Name <NAME@HOST>`; and which host carries it.

use std::net::IpAddr;

use lettre::Address;
use lettre::message::Mailbox;
use serde::{Deserialize, Deserializer, Serialize};

/// A mail address that can stand in a header and in an SMTP command as it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct MailAddress(Mailbox);

/// A text that is no mail address.
#[derive(Debug, thiserror::Error)]
#[error("{found:?} is no mail address; allowed is one NAME@HOST in ASCII, or Some Name <NAME@HOST>")]
pub struct NoMailAddress {
    found: String,
}

impl MailAddress {
    /// The address with its name, as headers want it.
    #[must_use]
    pub fn mailbox(&self) -> &Mailbox {
        &self.0
    }

    /// The bare `NAME@HOST`.
    #[must_use]
    pub fn bare(&self) -> &str {
        self.0.email.as_ref()
    }
}

impl From<MailAddress> for String {
    fn from(address: MailAddress) -> Self {
        address.0.to_string()
    }
}

impl TryFrom<String> for MailAddress {
    type Error = NoMailAddress;

    fn try_from(text: String) -> Result<Self, NoMailAddress> {
        match mailbox(&text) {
            Some(mailbox) => Ok(Self(mailbox)),
            None => Err(NoMailAddress { found: text }),
        }
    }
}

/// Like `Mailbox`'s own parser, which drops without a word what follows the first address.
fn mailbox(text: &str) -> Option<Mailbox> {
    if text.contains(char::is_control) {
        return None;
    }
    let (name, bare) = match text.trim().strip_suffix('>') {
        Some(rest) => rest.rsplit_once('<').map(|(name, bare)| (name.trim().trim_matches('"').trim(), bare))?,
        None => ("", text.trim()),
    };
    // That is an address too: whoever writes two means both.
    if name.contains(['<', '>']) {
        return None;
    }
    let address: Address = bare.parse().ok()?;
    // Any other letter needs SMTPUTF8, which few servers of a lab speak.
    let plain = bare.is_ascii() && !bare.contains([' ', ',', '<', '>', '"']);
    plain.then(|| Mailbox::new(Some(name.to_owned()).filter(|name| !name.is_empty()), address))
}

/// Reads an address that may be absent; an empty text counts as absent.
///
/// # Errors
/// When the value is anything else.
pub fn optional<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<MailAddress>, D::Error> {
    let text = Option::<String>::deserialize(deserializer)?.filter(|text| !text.is_empty());
    text.map(|text| MailAddress::try_from(text).map_err(serde::de::Error::custom)).transpose()
}

/// Whether a text can be the name or the IP address of an SMTP server.
#[must_use]
pub fn is_host(text: &str) -> bool {
    text.parse::<IpAddr>().is_ok() || (!text.contains(['[', '%']) && url::Host::parse(text).is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_may_have_a_name() {
        for (text, bare, name) in [
            ("admin@example.org", "admin@example.org", None),
            ("root@localhost", "root@localhost", None),
            (" first.last+fleet@mail.example.org ", "first.last+fleet@mail.example.org", None),
            ("Ada L\u{f6}v <ada@example.org>", "ada@example.org", Some("Ada L\u{f6}v")),
            ("\"Lab, Robots\" <lab@example.org>", "lab@example.org", Some("Lab, Robots")),
            ("<lab@example.org>", "lab@example.org", None),
        ] {
            let address = MailAddress::try_from(text.to_owned()).unwrap();
            assert_eq!((address.bare(), address.mailbox().name.as_deref()), (bare, name));
        }
    }

    #[test]
    fn anything_else_is_refused_by_name() {
        for text in [
            "admin",
            "admin@",
            "@example.org",
            "admin@example.org, other@example.org",
            "admin@example.org other",
            "Ada <ada@example.org> x",
            "Ada <ada@example.org>, Bo <bo@example.org>",
            "Ada ada@example.org>",
            "a b@example.org",
            "admin@exa mple.org",
            "admin@example.org\r\nBcc: other@example.org",
            "Ada\r\nBcc: other@example.org <ada@example.org>",
            "\u{e4}da@example.org",
        ] {
            let error = MailAddress::try_from(text.to_owned()).unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")), "{error}");
        }
    }

    #[test]
    fn a_host_is_a_name_or_an_address_without_a_port() {
        for host in ["localhost", "smtp.example.org", "10.0.0.7", "::1"] {
            assert!(is_host(host), "{host:?} was refused");
        }
        for other in ["", "smtp.example.org:587", "smtp://example.org", "a b", "[::1]", "user@host", "a\r\nb"] {
            assert!(!is_host(other), "{other:?} was taken");
        }
    }
}
