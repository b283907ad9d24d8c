//! The public address of a server: `HOST:PORT`, or `HOST/PORT` behind a reverse proxy that rewrites ports. If the proxy
//! does not listen on the default port, the address is `HOST:WEBPORT/PORT`.

use std::fmt;
use std::num::NonZeroU16;
use std::str::FromStr;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A server's public address.
///
/// With port rewrite (a reverse proxy on port 443 forwards `https://HOST/PORT/...` to that local port) the port is the
/// first segment of the path: `HOST/PORT`. Without port rewrite, the address is `HOST:PORT`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct PublicAddress {
    /// Shared, because addresses are used as keys and are cloned often.
    host: Arc<str>,
    port: u16,
    rewritten: bool,
}

/// Checks the key `server`, a host name or an IP address. An empty one becomes `localhost`, with a warning.
///
/// # Errors
/// When it is neither; the text says what was found, and what is expected.
pub fn complete_host(server: &mut String, rewritten: bool) -> Result<Option<String>, String> {
    if server.is_empty() {
        "localhost".clone_into(server);
        return Ok(Some("server is not set: URLs will name localhost".to_owned()));
    }
    let address = format!("{server}{}1", if rewritten { '/' } else { ':' });
    let checked = address.parse::<PublicAddress>().map(|_| None);
    checked.map_err(|_| {
        format!("server: {server:?} is no host; allowed are names and addresses, those of IPv6 in brackets")
    })
}

impl PublicAddress {
    /// The address of `port` on `host`; `rewritten`: whether a reverse proxy rewrites ports.
    pub fn new(host: &str, port: u16, rewritten: bool) -> Self {
        Self {
            host: host.into(),
            port,
            rewritten,
        }
    }

    /// The host in lower case, with the port of the reverse proxy if that is not the default.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// The port of the server itself.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Whether a reverse proxy rewrites ports.
    pub fn is_rewritten(&self) -> bool {
        self.rewritten
    }

    /// The WebSocket URL, without a slash at its end: `ws://HOST:PORT` or `wss://HOST/PORT`.
    pub fn websocket_url(&self, ssl: bool) -> String {
        format!("{}://{self}", if ssl { "wss" } else { "ws" })
    }

    /// The HTTP URL, without a slash at its end: `http://HOST:PORT` or `https://HOST/PORT`.
    pub fn http_url(&self, ssl: bool) -> String {
        format!("{}://{self}", if ssl { "https" } else { "http" })
    }
}

impl fmt::Display for PublicAddress {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "{}{}{}",
            self.host,
            if self.rewritten { '/' } else { ':' },
            self.port
        )
    }
}

impl From<PublicAddress> for String {
    fn from(address: PublicAddress) -> Self {
        address.to_string()
    }
}

impl TryFrom<String> for PublicAddress {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl FromStr for PublicAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let no_address =
            || format!("{text:?} is no address; allowed is HOST:PORT, or HOST/PORT where a web server rewrites ports");
        let (host, port, rewritten) = match text.split_once('/') {
            Some((host, port)) => (host, port, true),
            None => text
                .rsplit_once(':')
                .map(|(host, port)| (host, port, false))
                .ok_or_else(no_address)?,
        };
        let number = |text: &str| text.parse::<NonZeroU16>().map_err(|_| no_address());
        let name = match host.rsplit_once(':') {
            Some((name, web_port)) if rewritten && !host.ends_with(']') => number(web_port).map(|_| name)?,
            _ => host,
        };
        // Normalized, so that one server does not count as two: names in lower case (RFC 4343) and in ASCII.
        let plain = url::Host::parse(name).map_err(|_| no_address())?.to_string();
        if !plain
            .chars()
            .all(|letter| letter.is_ascii_alphanumeric() || "-._:[]".contains(letter))
        {
            return Err(no_address());
        }
        let host = format!("{plain}{}", host.strip_prefix(name).unwrap_or_default());
        Ok(Self {
            host: host.into(),
            port: number(port)?.get(),
            rewritten,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_are_read_and_a_name_is_written_in_one_way() {
        let plain = [
            "localhost:2000",
            "10.0.0.7/65535",
            "lab.org:8443/2000",
            "[::1]:2000",
            "[::1]/2000",
            "[::1]:8443/2000",
        ];
        for (text, plain) in plain.map(|text| (text, text)).into_iter().chain([
            ("Lab.ORG:2000", "lab.org:2000"),
            ("Lab.ORG:8443/2000", "lab.org:8443/2000"),
            ("b\u{fc}cher.example:2000", "xn--bcher-kva.example:2000"),
            ("a%2eb/2000", "a.b/2000"),
            ("127.1:02000", "127.0.0.1:2000"),
            ("[0:0::1]:2000", "[::1]:2000"),
        ]) {
            assert_eq!(text.parse::<PublicAddress>().unwrap().to_string(), plain);
        }
    }

    #[test]
    fn anything_else_is_refused_by_name() {
        let of_a_web_server = [
            "host/2000/x",
            "http://host:1",
            "host:x/2000",
            "host:0/2000",
            "host:1:2/2000",
        ];
        let short = [
            "",
            "host",
            "host:",
            "host:0",
            "host:65536",
            "a b:1",
            ":2000",
            "h:-1",
            "a\"b:1",
            "a;b:1",
        ];
        for text in short
            .into_iter()
            .chain(of_a_web_server)
            .chain([":8443/2000", "host:1:2"])
        {
            let error = text.parse::<PublicAddress>().unwrap_err();
            assert!(error.contains(&format!("{text:?}")), "{error}");
        }
    }
}
