//! Origins of web pages, as browsers send them (RFC 6454, section 6.1). Pure.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use url::Url;

/// Scheme, host and port of web pages, such as `https://lab.org`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String")]
pub struct Origin(pub String);

impl TryFrom<String> for Origin {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let parsed = Url::parse(&text)
            .ok()
            .filter(|url| matches!(url.scheme(), "http" | "https"));
        let origin = parsed.map_or("https://lab.org".to_owned(), |url| url.origin().ascii_serialization());
        // Browsers never send another spelling, so it would never match: it is an error.
        if text.eq_ignore_ascii_case(&origin) {
            Ok(Self(origin))
        } else {
            Err(format!("{text:?} is no origin; allowed is {origin:?}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_is_what_browsers_tell() {
        for (text, told) in [
            ("https://lab.org", "https://lab.org"),
            ("HTTPS://Lab.org", "https://lab.org"),
            ("http://127.0.0.1:8080", "http://127.0.0.1:8080"),
            ("http://[::1]:8080", "http://[::1]:8080"),
        ] {
            assert!(Origin::try_from(text.to_owned()).unwrap().0 == told, "{text}");
        }
        for (text, words) in [
            ("https://lab.org/", "allowed is \"https://lab.org\""),
            ("https://lab.org:443", "allowed is \"https://lab.org\""),
            ("https://me@lab.org/viewer", "allowed is \"https://lab.org\""),
            ("https://bücher.de", "allowed is \"https://xn--bcher-kva.de\""),
            ("lab.org", "allowed is \"https://lab.org\""),
            ("lab.org:443", "allowed is \"https://lab.org\""),
            ("*", "allowed is \"https://lab.org\""),
            ("null", "allowed is \"https://lab.org\""),
            ("file:///tmp", "allowed is \"https://lab.org\""),
            ("", "allowed is \"https://lab.org\""),
        ] {
            let wrong = Origin::try_from(text.to_owned()).unwrap_err();
            assert!(wrong.contains(words), "{text}: {wrong}");
        }
    }
}
