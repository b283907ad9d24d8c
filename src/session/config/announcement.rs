//! The key `announcement`: the administrator's message to all clients.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::shared::text::one_line;

/// The administrator's message to all clients. Without a text there is none.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Announcement {
    /// One line of text, never markup.
    #[serde(deserialize_with = "announced")]
    pub text: String,
}

/// Longest announcement, in characters.
const MAX_LENGTH: usize = 300;

fn announced<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = one_line(String::deserialize(deserializer)?.trim());
    if text.chars().count() > MAX_LENGTH {
        return Err(D::Error::custom(format!("the text of an announcement has at most {MAX_LENGTH} letters")));
    }
    Ok(text)
}
