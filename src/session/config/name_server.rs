//! The key `nameServers`: DNS servers to ask.

use std::net::{IpAddr, SocketAddr};

use serde::{Deserialize, Serialize};

/// A DNS server: an address, or `ADDRESS:PORT` where it is not at port 53.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct NameServer(pub SocketAddr);

/// The usual port of DNS.
const PORT: u16 = 53;

impl TryFrom<String> for NameServer {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let alone = text.parse::<IpAddr>().map(|address| SocketAddr::new(address, PORT));
        let address = alone.or_else(|_| text.parse()).ok().filter(|address| address.port() != 0);
        address.map(Self).ok_or_else(|| {
            format!(
                "{text:?} is no DNS server; allowed are addresses (10.0.0.53) and addresses with a port from 1 on \
                 (127.0.0.1:8600)"
            )
        })
    }
}

impl From<NameServer> for String {
    fn from(NameServer(address): NameServer) -> Self {
        address.to_string()
    }
}
