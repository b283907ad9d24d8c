//! The URLs and ports of this server and its simulations.

use std::net::{IpAddr, Ipv4Addr};
use std::ops::RangeInclusive;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::SimulationConfig;
use crate::shared::domain::{ClientUrls, PublicAddress};

/// How clients reach the streams of simulations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Streaming {
    /// Each at the port of its Webots.
    #[default]
    Direct,
    /// Through this server, with a token.
    Relay,
}

impl SimulationConfig {
    /// Returns this server's HTTP URL for clients.
    pub fn http_url(&self) -> String {
        self.client_urls().http_url(&self.address(self.port))
    }

    /// Returns the WebSocket URL for clients of a port of this server: its own, or that of a Webots.
    pub fn websocket_url(&self, port: u16) -> String {
        self.client_urls().websocket_url(&self.address(port))
    }

    /// Returns the URL under which a client reaches the stream of its simulation, which has this port and this token.
    pub fn stream_url(&self, port: u16, token: &str) -> String {
        match self.streaming {
            Streaming::Direct => self.websocket_url(port),
            Streaming::Relay => format!("{}/stream/{token}", self.websocket_url(self.port)),
        }
    }

    /// Whether clients reach simulations at their own ports, which must then be reachable from outside. Otherwise this
    /// server alone reaches them, on the machine itself.
    pub fn ports_are_public(&self) -> bool {
        self.streaming == Streaming::Direct
    }

    /// Returns the address to which the ports of containers are bound.
    pub fn bind_of_containers(&self) -> Ipv4Addr {
        match self.bind {
            _ if !self.ports_are_public() => Ipv4Addr::LOCALHOST,
            IpAddr::V4(bind) => bind,
            IpAddr::V6(_) => Ipv4Addr::UNSPECIFIED,
        }
    }

    /// Returns the address at which this server itself reaches simulations.
    pub fn address_of_simulations(&self) -> IpAddr {
        let bind = match self.bind {
            IpAddr::V6(bind) if !self.docker && self.ports_are_public() => bind.into(),
            _ => IpAddr::V4(self.bind_of_containers()),
        };
        if bind.is_unspecified() {
            Ipv4Addr::LOCALHOST.into()
        } else {
            bind
        }
    }

    fn client_urls(&self) -> ClientUrls {
        ClientUrls {
            ssl: self.ssl,
            public: self.public_url.clone(),
        }
    }

    fn address(&self, port: u16) -> PublicAddress {
        PublicAddress::new(&self.server, port, self.port_rewrite)
    }

    /// Returns the ports that Webots may use.
    pub fn streaming_ports(&self) -> RangeInclusive<u16> {
        self.port + 1..=self.port.saturating_add(self.max_connections)
    }
}
