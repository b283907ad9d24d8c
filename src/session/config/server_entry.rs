//! The key `simulationServers`: addresses of simulation servers, and names that are resolved by DNS.

use std::net::IpAddr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::domain::PublicAddress;

/// An entry of `simulationServers`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub enum ServerEntry {
    /// A simulation server.
    Server(PublicAddress),
    /// `dns+HOST:PORT`: all addresses of a host (A and AAAA), each with this port.
    ///
    /// Thanos, Loki and Mimir use the same notation. A URL `dns://...` means something else: its host is the DNS server
    /// (RFC 4501, also in gRPC).
    Name(PublicAddress),
}

impl ServerEntry {
    /// The address of the simulation server, unless this is a name.
    pub fn server(&self) -> Option<&PublicAddress> {
        if let Self::Server(address) = self {
            Some(address)
        } else {
            None
        }
    }

    /// The name to resolve and the port, unless this is an address.
    pub fn name(&self) -> Option<&PublicAddress> {
        if let Self::Name(name) = self { Some(name) } else { None }
    }
}

impl TryFrom<String> for ServerEntry {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let entry = match text.strip_prefix("dns+") {
            Some(name) => name.parse().ok().filter(is_name).map(Self::Name),
            None => text.parse().ok().map(Self::Server),
        };
        entry.ok_or_else(|| {
            format!(
                "{text:?} is no simulation server; allowed is HOST:PORT, or HOST/PORT where a web server rewrites \
                 ports, and dns+NAME:PORT for all addresses of a name"
            )
        })
    }
}

impl From<ServerEntry> for String {
    fn from(entry: ServerEntry) -> Self {
        match entry {
            ServerEntry::Server(address) => address.to_string(),
            ServerEntry::Name(name) => format!("dns+{name}"),
        }
    }
}

/// Whether an address has a host name to resolve and a port that is not rewritten.
fn is_name(address: &PublicAddress) -> bool {
    let is_address = address.host().starts_with('[') || address.host().parse::<IpAddr>().is_ok();
    !is_address && !address.is_rewritten()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<ServerEntry, String> {
        text.to_owned().try_into()
    }

    #[test]
    fn addresses_and_names_stand_side_by_side() {
        for text in ["localhost:2000", "lab.org/2000", "dns+tasks.simulation:2000"] {
            assert_eq!(String::from(read(text).unwrap()), text);
        }
        assert_eq!(
            String::from(read("dns+Tasks.Simulation:02000").unwrap()),
            "dns+tasks.simulation:2000"
        );
    }

    #[test]
    fn what_is_no_name_is_refused_in_words() {
        let names = "dns+ dns+host dns+host:0 dns+host:port dns+lab.org/2000 dns+lab.org:443/2000";
        let others =
            "dns+10.0.0.7:2000 dns+[::1]:2000 dnssrv+ dnssrv+_webots._tcp.example.org dns://a.b:2000 DNS+host:2000";
        for text in names.split(' ').chain(others.split(' ')).chain(["dns+a b:2000"]) {
            let error = read(text).unwrap_err();
            assert!(
                error.contains(&format!("{text:?}")) && error.contains("dns+NAME:PORT"),
                "{error}"
            );
        }
    }
}
