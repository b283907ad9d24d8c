//! The identity of a client, as far as it is known.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::shared::text::chosen_name;

/// The identity of a client. Only administrators see it: on pages, in the server's log and in `simulations.csv`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClientIdentity {
    /// The user name that a trusted reverse proxy sends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The name that the client has chosen; it is not checked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
}

impl ClientIdentity {
    /// The user's name as [`crate::shared::http::TrustedProxies::user`] returns it. What the client calls itself becomes
    /// one short line; an empty name becomes `None`.
    pub fn new(user: Option<String>, label: Option<&str>) -> Self {
        Self {
            user,
            label: label.and_then(chosen_name),
        }
    }
}

impl fmt::Display for ClientIdentity {
    /// For the server's own log; empty if nothing is known.
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(user) = &self.user {
            write!(out, ", user {user:?}")?;
        }
        if let Some(label) = &self.label {
            write!(out, ", calls itself {label:?}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_short_line() {
        let label = |text: &str| ClientIdentity::new(None, Some(text)).label;
        for (text, shown) in [
            (" Anna ", Some("Anna")),
            ("", None),
            (" \t\n", None),
            ("Anna\nuser \"root\"", Some("Anna user \"root\"")),
            ("\u{202e}annA", Some("\u{fffd}annA")),
            (&"x".repeat(99), Some("x".repeat(60).as_str())),
        ] {
            assert_eq!(label(text).as_deref(), shown, "{text:?}");
        }
        assert_eq!(
            ClientIdentity::new(Some("anna@lab".to_owned()), Some("A\"")).to_string(),
            r#", user "anna@lab", calls itself "A\"""#
        );
    }
}
