//! The monitors of simulation servers and of names, on a thread of their own, so that requests of clients do not wait
//! for them. Part of the registry.

use std::sync::Arc;

use actix::prelude::*;
use hickory_resolver::TokioResolver;
use rustls::ClientConfig;

use super::name_monitor::{LookupResult, NameMonitor};
use super::server_monitor::{ProbeResult, ProbeSettings, ServerMonitor, Stop};
use crate::session::config::DnsName;
use crate::shared::domain::PublicAddress;
use crate::shared::http::tls;
use crate::shared::run::{Supervisor, TooManyPanics};

/// All monitors, by server or name.
pub struct Monitors {
    makers: Makers,
    servers: Supervisor<PublicAddress, ServerMonitor>,
    names: Supervisor<DnsName, NameMonitor>,
}

/// Starts monitors.
struct Makers {
    thread: Arbiter,
    tls: Option<Arc<ClientConfig>>,
    resolver: TokioResolver,
    settings: ProbeSettings,
    results: MonitorRecipients,
}

/// Recipients of what the monitors find.
pub struct MonitorRecipients {
    /// Receives each probe of a simulation server.
    pub probes: Recipient<ProbeResult>,
    /// Receives each lookup of a name.
    pub lookups: Recipient<LookupResult>,
}

impl Makers {
    fn server(&self, server: &PublicAddress) -> Addr<ServerMonitor> {
        let (server, tls, results) = (server.clone(), self.tls.clone(), self.results.probes.clone());
        let (settings, resolver) = (self.settings, self.resolver.clone());
        ServerMonitor::start_in_arbiter(&self.thread.handle(), move |_| {
            ServerMonitor::new(server, settings, resolver, tls, results)
        })
    }

    fn name(&self, name: &DnsName) -> Addr<NameMonitor> {
        let (name, results) = (name.clone(), self.results.lookups.clone());
        NameMonitor::start_in_arbiter(&self.thread.handle(), move |_| NameMonitor::new(name, results))
    }
}

impl Monitors {
    /// Starts the thread, without monitors.
    pub fn new(resolver: TokioResolver, settings: ProbeSettings, results: MonitorRecipients) -> Self {
        let makers = Makers { thread: Arbiter::new(), tls: tls::client_config(), resolver, settings, results };
        Self { makers, servers: Supervisor::new("monitor of server"), names: Supervisor::new("monitor of name") }
    }

    /// Starts the monitor of a simulation server.
    pub fn watch(&mut self, server: &PublicAddress) {
        self.servers.add(server.clone(), self.makers.server(server));
    }

    /// Ends the monitor of a simulation server.
    pub fn unwatch(&mut self, server: &PublicAddress) {
        if let Some(monitor) = self.servers.remove(server) {
            monitor.do_send(Stop);
        }
    }

    /// Starts the monitor of a name.
    pub fn look_up(&mut self, name: &DnsName) {
        self.names.add(name.clone(), self.makers.name(name));
    }

    /// Ends the monitor of a name.
    pub fn stop_looking_up(&mut self, name: &DnsName) {
        if let Some(monitor) = self.names.remove(name) {
            monitor.do_send(Stop);
        }
    }

    /// Replaces monitors that have panicked.
    ///
    /// # Errors
    /// When there were too many panics.
    pub fn restart_gone(&mut self) -> Result<(), TooManyPanics> {
        self.servers.restart_gone(|server| Some(self.makers.server(server)))?;
        self.names.restart_gone(|name| Some(self.makers.name(name)))
    }

    /// Changes how servers are probed.
    pub fn set_probes(&mut self, settings: ProbeSettings) {
        if std::mem::replace(&mut self.makers.settings, settings) != settings {
            self.servers.all().for_each(|monitor| monitor.do_send(settings));
        }
    }
}
