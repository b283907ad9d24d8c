//! The thread in which all monitors run, so that requests of clients do not wait for them. Part of the registry.

use std::sync::Arc;

use actix::prelude::*;
use hickory_resolver::TokioResolver;
use rustls::ClientConfig;

use super::name_monitor::{LookupResult, NameMonitor};
use super::server_monitor::{ProbeResult, ProbeSettings, ServerMonitor};
use crate::session::config::{DnsName, SessionConfig};
use crate::shared::domain::PublicAddress;
use crate::shared::http::tls;

/// Starts monitors.
pub struct Monitors {
    thread: Arbiter,
    tls: Option<Arc<ClientConfig>>,
    resolver: TokioResolver,
}

/// Who hears what the monitors find.
pub struct Results {
    /// For each look at a simulation server.
    pub probes: Recipient<ProbeResult>,
    /// For each lookup of a name.
    pub lookups: Recipient<LookupResult>,
}

impl Monitors {
    /// A thread without monitors.
    pub fn new(resolver: TokioResolver) -> Self {
        Self { thread: Arbiter::new(), tls: tls::client_config(), resolver }
    }

    /// Starts the monitor of a simulation server.
    pub fn watch(&self, server: &PublicAddress, config: &SessionConfig, results: &Results) -> Addr<ServerMonitor> {
        let (server, tls, results) = (server.clone(), self.tls.clone(), results.probes.clone());
        let (settings, resolver) = (ProbeSettings::new(config), self.resolver.clone());
        ServerMonitor::start_in_arbiter(&self.thread.handle(), move |_| {
            ServerMonitor::new(server, settings, resolver, tls, results)
        })
    }

    /// Starts the monitor of a name.
    pub fn look_up(&self, name: &DnsName, results: &Results) -> Addr<NameMonitor> {
        let (name, results) = (name.clone(), results.lookups.clone());
        NameMonitor::start_in_arbiter(&self.thread.handle(), move |_| NameMonitor::new(name, results))
    }
}
