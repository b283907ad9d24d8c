//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.

use std::collections::HashMap;
use std::sync::Arc;

use actix::prelude::*;
use rustls::ClientConfig;
use tokio::sync::oneshot;

use super::name_table::NameTable;
use super::server_monitor::{ProbeResult, monitor};
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
    tls: Option<Arc<ClientConfig>>,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: Arbiter,
    results: Recipient<ProbeResult>,
}

impl ServerTable {
    /// No servers yet; `results` receives each probe.
    pub fn new(config: &Arc<SessionConfig>, results: Recipient<ProbeResult>) -> Self {
        Self {
            names: NameTable::default(),
            fleet: LoadBalancer::new(config.policy()),
            monitors: HashMap::new(),
            records: HashMap::new(),
            listed: Vec::new(),
            tls: None,
            thread: Arbiter::new(),
            results,
        }
    }

    /// Applies a configuration. Each server is probed at once, by a new monitor.
    pub fn apply(&mut self, config: &Arc<SessionConfig>) {
        self.tls = tls::client_config();
        for server in self.listed.clone() {
            self.start_monitor(server, config);
        }
        self.fleet.set_policy(config.policy());
        self.names.apply(&config.simulation_servers);
        self.follow_names(config);
    }

    /// Follows the configuration and its names: removes servers that are no longer listed, and adds new ones.
    pub fn follow_names(&mut self, config: &Arc<SessionConfig>) {
        self.listed = self.names.servers(&config.simulation_servers);
        let mut before = std::mem::take(&mut self.records);
        for server in self.listed.clone() {
            let mut record = before.remove(&server).unwrap_or_else(|| {
                self.fleet.add(server.clone());
                self.start_monitor(server.clone(), config);
                ServerRecord::new(server.clone())
            });
            record.drained = config.drained_servers.contains(&server);
            self.records.insert(server, record);
        }
        for server in before.into_keys() {
            log::info!("{server}: no longer watched");
            self.monitors.remove(&server);
            self.fleet.remove(&server);
        }
    }

    /// Starts the monitor of a server, replacing one that runs.
    fn start_monitor(&mut self, server: PublicAddress, config: &Arc<SessionConfig>) {
        let (sender, stopped) = oneshot::channel();
        self.monitors.insert(server.clone(), sender);
        let (config, tls, results) = (Arc::clone(config), self.tls.clone(), self.results.clone());
        self.thread.spawn_fn(move || {
            actix_rt::spawn(async move {
                let name = format!("monitor of server {server}");
                let probe = async || monitor(server.clone(), &config, tls.clone(), results.clone()).await;
                tokio::select! {
                    () = permanent::restarted(&name, probe) => {}
                    _ = stopped => {}
                }
            });
        });
    }

    /// What is known of all servers, in the order of the configuration.
    pub fn in_order(&self) -> impl Iterator<Item = &ServerRecord> {
        self.listed.iter().filter_map(|server| self.records.get(server))
    }
}
