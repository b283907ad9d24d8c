//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.
//!
//! A server that no name resolves to any more gets no clients. It is monitored as long as it answers, because a name
//! may resolve to it again, and so that its clients stay visible until they have left.

use std::collections::hash_map::Entry;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use actix::prelude::*;
use rustls::ClientConfig;
use tokio::sync::oneshot;

use super::name_table::NameTable;
use super::server_monitor::{ProbeResult, ProbeSettings, monitor};
use super::server_record::ServerRecord;
use crate::session::config::SessionConfig;
use crate::session::placement::LoadBalancer;
use crate::shared::domain::PublicAddress;
use crate::shared::http::tls;
use crate::shared::run::permanent;

/// All servers and names, with the servers' monitors.
pub struct ServerTable {
    /// The names of the configuration that are resolved.
    pub names: NameTable,
    /// What is known of placing clients on the servers.
    pub fleet: LoadBalancer<PublicAddress>,
    /// The tasks that probe the servers: each ends when its sender is dropped.
    monitors: HashMap<PublicAddress, oneshot::Sender<()>>,
    /// What is known of each server.
    pub records: HashMap<PublicAddress, ServerRecord>,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    settings: ProbeSettings,
    tls: Option<Arc<ClientConfig>>,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: Arbiter,
    results: Recipient<ProbeResult>,
}

impl ServerTable {
    /// No servers yet; `results` receives each probe.
    pub fn new(config: &SessionConfig, results: Recipient<ProbeResult>) -> Self {
        Self {
            names: NameTable::default(),
            fleet: LoadBalancer::new(config.policy()),
            monitors: HashMap::new(),
            records: HashMap::new(),
            listed: Vec::new(),
            settings: ProbeSettings::new(config),
            tls: tls::client_config(),
            thread: Arbiter::new(),
            results,
        }
    }

    /// Applies a configuration: servers that it no longer lists are removed.
    pub fn apply(&mut self, config: &SessionConfig) {
        let settings = ProbeSettings::new(config);
        if std::mem::replace(&mut self.settings, settings) != settings {
            for server in self.records.keys().cloned().collect::<Vec<_>>() {
                self.start_monitor(server);
            }
        }
        self.fleet.set_policy(config.policy());
        self.names.apply(&config.simulation_servers);
        self.list(config, |_| true);
    }

    /// Applies changed names: a server that no name resolves to any more is removed if it does not answer.
    pub fn follow_names(&mut self, config: &SessionConfig) {
        self.list(config, |record| record.current().is_none());
    }

    /// Follows the lists of servers and of drained servers. Those that are in no list are removed if they are `gone`.
    fn list(&mut self, config: &SessionConfig, gone: impl Fn(&ServerRecord) -> bool) {
        self.listed = self.names.servers(&config.simulation_servers);
        let listed: BTreeSet<&PublicAddress> = self.listed.iter().collect();
        for (server, record) in &mut self.records {
            record.unlisted = !listed.contains(server);
            record.drained = config.drained_servers.contains(server);
        }
        let unlisted = self.records.iter().filter(|(_, record)| record.unlisted && gone(record));
        for server in unlisted.map(|(server, _)| server.clone()).collect::<Vec<_>>() {
            self.forget(&server);
        }
        let new = self.listed.iter().filter(|server| !self.records.contains_key(*server));
        for server in new.cloned().collect::<Vec<_>>() {
            if let Entry::Vacant(entry) = self.records.entry(server.clone()) {
                entry.insert(ServerRecord::new(server.clone(), config.drained_servers.contains(&server)));
                self.fleet.add(server.clone());
                self.start_monitor(server);
            }
        }
    }

    /// Starts the monitor of a server, in place of the one that it has.
    fn start_monitor(&mut self, server: PublicAddress) {
        let (sender, stopped) = oneshot::channel();
        self.monitors.insert(server.clone(), sender);
        let (settings, tls, results) = (self.settings, self.tls.clone(), self.results.clone());
        self.thread.spawn_fn(move || {
            actix_rt::spawn(async move {
                let name = format!("monitor of server {server}");
                let probe = async || monitor(server.clone(), settings, tls.clone(), results.clone()).await;
                tokio::select! {
                    () = permanent::restarted(&name, probe) => {}
                    _ = stopped => {}
                }
            });
        });
    }

    /// Removes a server and stops its monitor.
    pub fn forget(&mut self, server: &PublicAddress) {
        if self.records.remove(server).is_some() {
            log::info!("{server}: no longer watched");
            self.monitors.remove(server);
            self.fleet.remove(server);
        }
    }

    /// What is known of all servers, in the order of the configuration; those that are no longer listed come last.
    pub fn in_order(&self) -> impl Iterator<Item = &ServerRecord> {
        let unlisted = self.records.iter().filter(|(_, record)| record.unlisted);
        let unlisted: BTreeSet<_> = unlisted.map(|(server, _)| server).collect();
        self.listed.iter().chain(unlisted).filter_map(|server| self.records.get(server))
    }
}
