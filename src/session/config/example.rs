//! The key `examples`: worlds that the page `/viewer` offers.

use serde::{Deserialize, Serialize};

/// An example on the page `/viewer`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "WireExample")]
pub struct Example {
    /// Its title. Default: the URL.
    pub title: String,
    /// The world's URL.
    pub url: String,
}

#[derive(Deserialize)]
#[serde(untagged, deny_unknown_fields, expecting = "it is neither a URL nor {\"title\": ..., \"url\": ...}")]
enum WireExample {
    Url(String),
    Titled { title: Option<String>, url: String },
}

impl From<WireExample> for Example {
    fn from(wire: WireExample) -> Self {
        let (title, url) = match wire {
            WireExample::Url(url) => (None, url),
            WireExample::Titled { title, url } => (title, url),
        };
        Self { title: title.unwrap_or_else(|| url.clone()), url }
    }
}
