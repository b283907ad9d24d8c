//! The key `announcement`: the administrator's message to all clients.

use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::shared::run::timestamp;
use crate::shared::text::one_line;

/// The administrator's message to all clients.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "AnnouncementKeys", into = "AnnouncementKeys")]
pub struct Announcement {
    /// One line of text, never markup.
    pub text: String,
    /// When it is over, if that is said.
    pub until: Option<SystemTime>,
}

/// The same as it is written in JSON.
#[derive(Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AnnouncementKeys {
    /// The text.
    pub text: String,
    /// A time of RFC 3339 in UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub until: Option<String>,
}

/// Longest announcement, in characters.
const MAX_LENGTH: usize = 300;

impl Announcement {
    /// Whether it is over.
    pub fn is_over(&self) -> bool {
        self.until.is_some_and(|until| until <= SystemTime::now())
    }
}

impl TryFrom<AnnouncementKeys> for Announcement {
    type Error = String;

    fn try_from(AnnouncementKeys { text, until }: AnnouncementKeys) -> Result<Self, String> {
        let text = one_line(text.trim());
        if text.is_empty() || text.chars().count() > MAX_LENGTH {
            return Err(format!("the text of an announcement has 1 to {MAX_LENGTH} letters"));
        }
        let until = until.map(|until| {
            let wrong = |_| format!("until is {until:?}; allowed are times such as 2026-12-31T12:00:00Z (UTC)");
            humantime::parse_rfc3339(&until).map_err(wrong)
        });
        Ok(Self { text, until: until.transpose()? })
    }
}

impl From<Announcement> for AnnouncementKeys {
    fn from(Announcement { text, until }: Announcement) -> Self {
        Self { text, until: until.map(timestamp) }
    }
}
