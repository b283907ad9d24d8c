//! The URLs under which clients reach the servers of a fleet. Pure.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::address::PublicAddress;
use crate::shared::config::expand;

/// The WebSocket URL of servers behind one reverse proxy, with placeholders: `wss://DOOR/{host}/{port}`. `$VARIABLE` is
/// expanded in it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct PublicUrl {
    /// The WebSocket URL of the reverse proxy, without a slash at its end.
    door: String,
    /// The path below that URL, with placeholders.
    path: String,
}

impl PublicUrl {
    /// Returns the WebSocket URL of the reverse proxy itself, without a slash at its end.
    pub fn websocket_door(&self) -> String {
        self.door.clone()
    }

    /// Returns the HTTP URL of the reverse proxy itself, without a slash at its end.
    pub fn http_door(&self) -> String {
        with_http(&self.door)
    }

    fn websocket_url(&self, address: &PublicAddress) -> String {
        let path = self
            .path
            .replace("{host}", address.host())
            .replace("{port}", &address.port().to_string());
        format!("{}{path}", self.door)
    }
}

impl TryFrom<String> for PublicUrl {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let text = expand(&text)?;
        let parts = || {
            let (scheme, rest) = text.split_once("://")?;
            let (door, path) = rest.split_at_checked(rest.find('/')?)?;
            // The name is normalized, as in the address of a server.
            let door: PublicAddress = format!("{door}/1").parse().ok()?;
            let plain = path.replacen("{host}", "", 1).replacen("{port}", "", 1);
            let is_of_path = |letter: char| letter.is_ascii_alphanumeric() || "/-._".contains(letter);
            let fits = path.contains("{port}") && !path.ends_with('/') && plain.chars().all(is_of_path);
            let door = format!("{scheme}://{}", door.host());
            (fits && matches!(scheme, "ws" | "wss")).then(|| Self {
                door,
                path: path.to_owned(),
            })
        };
        parts().ok_or_else(|| {
            format!("{text:?} is not allowed; allowed is such as \"wss://fleet.example.org/{{host}}/{{port}}\"")
        })
    }
}

impl From<PublicUrl> for String {
    fn from(url: PublicUrl) -> Self {
        url.door + &url.path
    }
}

/// Forms the URLs of a fleet's servers for clients.
#[derive(Debug, Clone)]
pub struct ClientUrls {
    /// Whether URLs begin with `https` and `wss`, if there is no public URL.
    pub ssl: bool,
    /// The URL of servers behind one reverse proxy.
    pub public: Option<PublicUrl>,
}

impl ClientUrls {
    /// Returns the WebSocket URL of a server, without a slash at its end.
    pub fn websocket_url(&self, address: &PublicAddress) -> String {
        self.public.as_ref().map_or_else(
            || address.websocket_url(self.ssl),
            |public| public.websocket_url(address),
        )
    }

    /// Returns the HTTP URL of a server, without a slash at its end.
    pub fn http_url(&self, address: &PublicAddress) -> String {
        with_http(&self.websocket_url(address))
    }
}

/// The same URL for HTTP: `ws` becomes `http`, and `wss` becomes `https`.
fn with_http(websocket_url: &str) -> String {
    websocket_url.replacen("ws", "http", 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn public(text: &str) -> Result<PublicUrl, String> {
        text.to_owned().try_into()
    }

    #[test]
    fn host_and_port_are_filled_in() {
        let address: PublicAddress = "10.0.1.7:2000".parse().unwrap();
        for (text, websocket, http) in [
            (
                "wss://fleet.org/{host}/{port}",
                "wss://fleet.org/10.0.1.7/2000",
                "https://fleet.org/10.0.1.7/2000",
            ),
            (
                "ws://Fleet.org:8080/a/{port}",
                "ws://fleet.org:8080/a/2000",
                "http://fleet.org:8080/a/2000",
            ),
            (
                "wss://[::1]/{port}-{host}",
                "wss://[::1]/2000-10.0.1.7",
                "https://[::1]/2000-10.0.1.7",
            ),
        ] {
            let url = ClientUrls {
                ssl: false,
                public: Some(public(text).unwrap()),
            };
            assert_eq!(
                (url.websocket_url(&address).as_str(), url.http_url(&address).as_str()),
                (websocket, http)
            );
        }
        let url = public("wss://fleet.org/{host}/{port}").unwrap();
        assert_eq!(
            (url.websocket_door(), url.http_door()),
            ("wss://fleet.org".into(), "https://fleet.org".into())
        );
        assert_eq!(String::from(url), "wss://fleet.org/{host}/{port}");
    }

    #[test]
    fn other_texts_are_refused_with_one_that_is_allowed() {
        let paths = [
            "",
            "/",
            "/{host}",
            "/{port}/",
            "/{port}?a",
            "/{port}/{port}",
            "/{name}/{port}",
        ];
        let others = [
            "",
            "https://fleet.org/{port}",
            "wss://{host}/{port}",
            "wss://a:b@fleet.org/{port}",
        ];
        for text in paths
            .map(|path| format!("wss://fleet.org{path}"))
            .into_iter()
            .chain(others.map(str::to_owned))
        {
            let error = public(&text).unwrap_err();
            assert!(error.contains(r#""wss://fleet.example.org/{host}/{port}""#), "{error}");
        }
    }
}
