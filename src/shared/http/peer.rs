//! The client at the other end of a connection, possibly behind a reverse proxy.
//!
//! A reverse proxy sends its client's address in the header `X-Forwarded-For`. Any client can set this header. It
//! counts only on connections from a trusted proxy, and is read from its end: each trusted proxy has appended the
//! address that it saw, and the last address that is not a trusted proxy is the client's.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use actix_web::HttpRequest;
use actix_web::http::header::HeaderMap;
use ipnet::IpNet;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::text::user_name;

/// The networks of proxies whose header `X-Forwarded-For` is trusted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "Vec<String>")]
#[schemars(with = "Vec<String>")]
pub struct TrustedProxies(Vec<IpNet>);

/// The client at the other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// The client's own address; or, if a hop in the header is invalid, that of the proxy which added that hop.
    Client(IpAddr),
    /// A trusted proxy that sends no header, or a client on the same machine: it may stand for many clients.
    Proxy(IpAddr),
}

impl Peer {
    /// The key of rate limits for this client, if its address is known. An IPv6 client has a whole /64 of addresses,
    /// which count as one.
    pub fn rate_limit_key(self) -> Option<IpAddr> {
        match self {
            Self::Client(IpAddr::V6(address)) => Some(Ipv6Addr::from_bits(address.to_bits() >> 64 << 64).into()),
            Self::Client(address) => Some(address),
            Self::Proxy(_) => None,
        }
    }
}

impl TrustedProxies {
    /// The client of a request.
    pub fn peer(&self, request: &HttpRequest) -> Peer {
        // Only requests in unit tests have no address.
        let address = request
            .peer_addr()
            .map_or(Ipv4Addr::UNSPECIFIED.into(), |address| address.ip());
        self.resolve(address.to_canonical(), request.headers())
    }

    /// The client of a connection on which no request was received yet.
    pub fn of_connection(&self, address: IpAddr) -> Peer {
        self.resolve(address.to_canonical(), &HeaderMap::new())
    }

    /// The user that a trusted proxy names in this header; `None` if the header is empty, or repeated, because the client
    /// may have sent one of them.
    pub fn user(&self, request: &HttpRequest, header: &str) -> Option<String> {
        let is_trusted = request
            .peer_addr()
            .is_some_and(|address| self.trusts(address.ip().to_canonical()));
        let mut lines = request.headers().get_all(header).filter(|_| is_trusted);
        match (lines.next(), lines.next()) {
            (Some(line), None) => std::str::from_utf8(line.as_bytes()).ok().and_then(user_name),
            _ => None,
        }
    }

    /// The last address of the header's chain that is not a trusted proxy. A hop that is not an address ends the chain.
    fn resolve(&self, connected: IpAddr, headers: &HeaderMap) -> Peer {
        if !self.trusts(connected) {
            return Peer::Client(connected);
        }
        // A line that is not text is not an address.
        let lines: Vec<&str> = headers
            .get_all("x-forwarded-for")
            .map(|line| line.to_str().unwrap_or("?"))
            .collect();
        if lines.is_empty() {
            return Peer::Proxy(connected);
        }
        let mut nearest = connected;
        for hop in lines.join(",").rsplit(',').map_while(|hop| address(hop.trim())) {
            nearest = hop;
            if !self.trusts(hop) {
                break;
            }
        }
        Peer::Client(nearest)
    }

    /// Whether programs on this machine are trusted.
    pub fn trusts_loopback(&self) -> bool {
        self.trusts(Ipv4Addr::LOCALHOST.into()) || self.trusts(Ipv6Addr::LOCALHOST.into())
    }

    fn trusts(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.contains(&address))
    }
}

/// Parses an address as reverse proxies write it: some add the port.
fn address(text: &str) -> Option<IpAddr> {
    let bare = text
        .strip_prefix('[')
        .and_then(|text| text.strip_suffix(']'))
        .unwrap_or(text);
    let address = bare
        .parse()
        .ok()
        .or_else(|| text.parse::<SocketAddr>().ok().map(|address| address.ip()));
    address.as_ref().map(IpAddr::to_canonical)
}

impl Default for TrustedProxies {
    fn default() -> Self {
        let loopback = ["127.0.0.0/8", "::1/128"];
        Self(loopback.iter().filter_map(|network| network.parse().ok()).collect())
    }
}

impl TryFrom<Vec<String>> for TrustedProxies {
    type Error = String;

    fn try_from(texts: Vec<String>) -> Result<Self, String> {
        let network = |text: String| {
            let alone = text.parse::<IpAddr>().map(IpNet::from);
            alone.or_else(|_| text.parse::<IpNet>()).map_err(|_| {
                format!("{text:?} is no network; allowed are addresses (10.0.0.1, fd00::1) and networks (10.0.0.0/8, fd00::/8)")
            })
        };
        texts.into_iter().map(network).collect::<Result<_, _>>().map(Self)
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Client(address) | Self::Proxy(address)) = self;
        address.fmt(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use actix_web::http::header::{HeaderName, HeaderValue};

    fn resolve(trusted: &[&str], connected: &str, headers: Headers<'_>) -> Peer {
        let trusted: Vec<String> = trusted.iter().map(|&text| text.to_owned()).collect();
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(HeaderName::from_static(name), HeaderValue::from_str(value).unwrap());
        }
        TrustedProxies::try_from(trusted)
            .unwrap()
            .resolve(connected.parse().unwrap(), &map)
    }

    type Headers<'a> = &'a [(&'static str, &'a str)];

    #[test]
    fn the_client_is_who_the_nearest_trusted_proxy_saw() {
        let common = "x-forwarded-for";
        let table: &[(&str, Headers<'_>, &str, &str)] = &[
            (
                "203.0.113.9",
                &[(common, "1.1.1.1")],
                "203.0.113.9",
                "a stranger's word on itself",
            ),
            ("127.0.0.1", &[(common, "203.0.113.9")], "203.0.113.9", "one proxy"),
            (
                "127.0.0.1",
                &[(common, "1.1.1.1, 203.0.113.9")],
                "203.0.113.9",
                "the client wrote one itself",
            ),
            (
                "127.0.0.1",
                &[(common, "1.1.1.1"), (common, "203.0.113.9")],
                "203.0.113.9",
                "the same, in two lines",
            ),
            (
                "127.0.0.1",
                &[(common, "203.0.113.9, 10.1.2.3")],
                "203.0.113.9",
                "two proxies",
            ),
            (
                "127.0.0.1",
                &[(common, "10.1.2.3")],
                "10.1.2.3",
                "a client in the proxies' network",
            ),
            (
                "127.0.0.1",
                &[(common, "203.0.113.9, ?, 10.1.2.3")],
                "10.1.2.3",
                "what is no address ends the chain",
            ),
            (
                "127.0.0.1",
                &[(common, "unknown")],
                "127.0.0.1",
                "nothing sensible is said",
            ),
            (
                "127.0.0.1",
                &[(common, "203.0.113.9:4711")],
                "203.0.113.9",
                "with a port",
            ),
            ("::1", &[(common, "2001:db8::9")], "2001:db8::9", "IPv6"),
            (
                "127.0.0.1",
                &[(common, "[2001:db8::9]:4711")],
                "2001:db8::9",
                "IPv6 with a port",
            ),
            (
                "127.0.0.1",
                &[(common, "::ffff:203.0.113.9")],
                "203.0.113.9",
                "IPv4 in IPv6",
            ),
        ];
        for (connected, headers, client, why) in table {
            let peer = resolve(&["127.0.0.0/8", "::1", "10.0.0.0/8"], connected, headers);
            assert_eq!(peer, Peer::Client(client.parse().unwrap()), "{why}");
        }
    }

    #[test]
    fn a_proxy_that_says_nothing_is_known_as_one() {
        assert_eq!(
            resolve(&["127.0.0.0/8"], "127.0.0.1", &[]),
            Peer::Proxy("127.0.0.1".parse().unwrap())
        );
        assert_eq!(
            resolve(&[], "127.0.0.1", &[]),
            Peer::Client("127.0.0.1".parse().unwrap())
        );
    }

    #[test]
    fn networks_are_read_from_texts() {
        let read = |text: &str| serde_json::from_str::<TrustedProxies>(text);
        let default = serde_json::to_string(&TrustedProxies::default()).unwrap();
        assert_eq!(default, r#"["127.0.0.0/8","::1/128"]"#);
        assert_eq!(read(&default).unwrap(), TrustedProxies::default());
        assert!(read(r#"["10.0.0.1", "fd00::/8"]"#).is_ok());
        let error = read(r#"["10.0.0.0/33"]"#).unwrap_err().to_string();
        assert!(error.contains(r#""10.0.0.0/33" is no network"#), "{error}");
    }
}
