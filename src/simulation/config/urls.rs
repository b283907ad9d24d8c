//! Under which URLs and ports clients reach this server and its simulations.

use std::ops::RangeInclusive;

use super::SimulationConfig;
use crate::shared::domain::{ClientUrls, PublicAddress};

/// If its port is taken, Webots silently takes one of this many that follow.
const NEXT_PORTS: u16 = 10;

impl SimulationConfig {
    /// Returns the HTTP URL under which clients reach this server.
    #[must_use]
    pub fn http_url(&self) -> String {
        self.client_urls().http_url(&self.address(self.port))
    }

    /// Returns the WebSocket URL under which clients reach a port of this server: its own, or that of a Webots.
    #[must_use]
    pub fn websocket_url(&self, port: u16) -> String {
        self.client_urls().websocket_url(&self.address(port))
    }

    fn client_urls(&self) -> ClientUrls {
        ClientUrls { ssl: self.ssl, public: self.public_url.clone() }
    }

    fn address(&self, port: u16) -> PublicAddress {
        PublicAddress::new(&self.server, port, self.port_rewrite)
    }

    /// Returns the ports that Webots may use.
    #[must_use]
    pub fn streaming_ports(&self) -> RangeInclusive<u16> {
        self.port + 1..=self.port.saturating_add(self.max_connections)
    }

    /// Returns the ports on which a Webots may come to listen that was given this one.
    #[must_use]
    pub fn ports_from(port: u16) -> RangeInclusive<u16> {
        port..=port.saturating_add(NEXT_PORTS)
    }
}
