//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.

use std::collections::HashMap;
use std::sync::Arc;

use actix::prelude::*;

use super::name_table::NameTable;
use super::server_monitor::{ProbeResult, monitor};
use super::server_record::ServerRecord;
use crate::session::config::SessionConfig;
use crate::session::placement::LoadBalancer;
use crate::shared::domain::PublicAddress;
use crate::shared::http::tls;
use crate::shared::run::Supervisor;

/// All servers and names, with the servers' monitors.
pub struct ServerTable {
    /// The names of the configuration that are resolved.
    pub names: NameTable,
    /// What is known of placing clients on the servers.
    pub fleet: LoadBalancer<PublicAddress>,
    /// The tasks that probe the servers.
    pub monitors: Monitors,
    /// What is known of each server.
    pub records: HashMap<PublicAddress, ServerRecord>,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: Arbiter,
    results: Recipient<ProbeResult>,
}

/// The monitors, by server. They get no messages.
type Monitors = Supervisor<PublicAddress, ()>;

impl ServerTable {
    /// No servers yet; `results` receives each probe.
    pub fn new(config: &Arc<SessionConfig>, results: Recipient<ProbeResult>) -> Self {
        let thread = Arbiter::new();
        Self {
            names: NameTable::default(),
            fleet: LoadBalancer::new(config.policy()),
            monitors: monitors(&thread, config, results.clone()),
            records: HashMap::new(),
            listed: Vec::new(),
            thread,
            results,
        }
    }

    /// Applies a configuration. Each server is probed at once, by new monitors.
    pub fn apply(&mut self, config: &Arc<SessionConfig>) {
        self.monitors = monitors(&self.thread, config, self.results.clone());
        self.listed.iter().for_each(|server| self.monitors.add(server.clone()));
        self.fleet.set_policy(config.policy());
        self.names.apply(&config.simulation_servers);
        self.follow_names(config);
    }

    /// Follows the configuration and its names: removes servers that are no longer listed, and adds new ones.
    pub fn follow_names(&mut self, config: &SessionConfig) {
        self.listed = self.names.servers(&config.simulation_servers);
        let mut before = std::mem::take(&mut self.records);
        for server in &self.listed {
            let mut record = before.remove(server).unwrap_or_else(|| {
                self.fleet.add(server.clone());
                self.monitors.add(server.clone());
                ServerRecord::new(server.clone())
            });
            record.drained = config.drained_servers.contains(server);
            self.records.insert(server.clone(), record);
        }
        for server in before.into_keys() {
            log::info!("{server}: no longer watched");
            self.monitors.remove(&server);
            self.fleet.remove(&server);
        }
    }

    /// What is known of all servers, in the order of the configuration.
    pub fn in_order(&self) -> impl Iterator<Item = &ServerRecord> {
        self.listed.iter().filter_map(|server| self.records.get(server))
    }
}

/// No monitors yet; they run on this thread.
fn monitors(thread: &Arbiter, config: &Arc<SessionConfig>, results: Recipient<ProbeResult>) -> Monitors {
    let (thread, config, tls) = (thread.handle(), Arc::clone(config), tls::client_config());
    Supervisor::new("monitor of server", move |server: &PublicAddress, mut stopped| {
        let (server, config, tls, results) = (server.clone(), Arc::clone(&config), tls.clone(), results.clone());
        thread.spawn_fn(move || {
            actix_rt::spawn(async move {
                tokio::select! {
                    () = monitor(server, &config, tls, results) => {}
                    _ = stopped.recv() => {}
                }
            });
        });
    })
}
