//! Who a client is, as far as somebody says.

use std::fmt;

use crate::shared::text::one_line;

/// Who a client is. Pages show it to administrators alone; it is in the server's own log and in `simulations.csv`, and in
/// nothing that others read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Who {
    /// The user whom a trusted web server names.
    pub user: Option<String>,
    /// What the client calls itself, which nobody has checked.
    pub label: Option<String>,
}

/// How many letters of a user's name count.
const USER_LENGTH: usize = 200;
/// How many letters of a label are shown.
const LABEL_LENGTH: usize = 60;

impl Who {
    /// Names of at most so many letters in one line; an empty one is none.
    pub fn new(user: Option<&str>, label: Option<&str>) -> Self {
        let cut = |text: &str, most| one_line(text).trim().chars().take(most).collect::<String>();
        let cut = |text: Option<&str>, most| text.map(|text| cut(text, most)).filter(|text| !text.is_empty());
        Self { user: cut(user, USER_LENGTH), label: cut(label, LABEL_LENGTH) }
    }
}

impl fmt::Display for Who {
    /// For the server's own log; nothing where nothing is known.
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
        let label = |text: &str| Who::new(None, Some(text)).label;
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
        assert_eq!(Who::new(Some("anna@lab"), Some("A\"")).to_string(), r#", user "anna@lab", calls itself "A\"""#);
    }
}
