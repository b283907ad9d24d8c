//! Mail addresses in the configuration.

use std::borrow::Cow;

use lettre::message::Mailbox;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A mail address that may be absent, as `NAME@HOST` or `Some Name <NAME@HOST>`. An empty text counts as absent.
pub struct MailAddress;

impl MailAddress {
    /// Reads the address.
    ///
    /// # Errors
    /// When the text is not a mail address, is several, or its address is not ASCII: other characters need SMTPUTF8, which
    /// few servers support.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Mailbox>, D::Error> {
        let Some(text) = Option::<String>::deserialize(deserializer)?.filter(|text| !text.is_empty()) else {
            return Ok(None);
        };
        let is_plain = |mailbox: &Mailbox| AsRef::<str>::as_ref(&mailbox.email).is_ascii();
        let mailbox = text
            .parse()
            .ok()
            .filter(is_plain)
            .filter(|_| !text.contains(char::is_control));
        mailbox.map(Some).ok_or_else(|| {
            let allowed = "allowed is one NAME@HOST in ASCII, or Some Name <NAME@HOST>";
            serde::de::Error::custom(format!("{text:?} is no mail address; {allowed}"))
        })
    }

    /// Writes the address.
    ///
    /// # Errors
    /// When the output fails.
    pub fn serialize<T: Serialize, S: Serializer>(address: &T, serializer: S) -> Result<S::Ok, S::Error> {
        address.serialize(serializer)
    }
}

impl JsonSchema for MailAddress {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "MailAddress".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({"type": ["string", "null"]})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Option<Mailbox>, serde_json::Error> {
        MailAddress::deserialize(serde_json::Value::from(text))
    }

    #[test]
    fn an_address_may_have_a_name() {
        for (text, address, name) in [
            ("admin@example.org", "admin@example.org", None),
            ("root@localhost", "root@localhost", None),
            (
                " first.last+fleet@mail.example.org ",
                "first.last+fleet@mail.example.org",
                None,
            ),
            (
                "Ada L\u{f6}v <ada@example.org>",
                "ada@example.org",
                Some("Ada L\u{f6}v"),
            ),
            (
                "\"Lab, Robots\" <lab@example.org>",
                "lab@example.org",
                Some("Lab, Robots"),
            ),
            ("<lab@example.org>", "lab@example.org", None),
        ] {
            let mailbox = read(text).unwrap().unwrap();
            assert_eq!((mailbox.email.as_ref(), mailbox.name.as_deref()), (address, name));
        }
        assert_eq!(read("").unwrap(), None);
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
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")), "{error}");
        }
    }
}
