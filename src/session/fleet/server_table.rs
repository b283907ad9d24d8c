//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.
//!
//! A server that no name resolves to any more gets no clients. It is monitored as long as it answers, because a name
//! may resolve to it again, and so that its clients stay visible until they have left.

use std::collections::hash_map::Entry;
use std::collections::{BTreeSet, HashMap};

use actix::prelude::*;

use super::name_table::NameTable;
use super::server_monitor::{ProbeResult, ProbeSettings, monitor};
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
    settings: ProbeSettings,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: Arbiter,
    results: Recipient<ProbeResult>,
}

/// The monitors, by server. They get no messages.
type Monitors = Supervisor<PublicAddress, ()>;

impl ServerTable {
    /// No servers yet; `results` receives each probe.
    pub fn new(config: &SessionConfig, results: Recipient<ProbeResult>) -> Self {
        let (settings, thread) = (ProbeSettings::new(config), Arbiter::new());
        Self {
            names: NameTable::default(),
            fleet: LoadBalancer::new(config.policy()),
            monitors: monitors(&thread, settings, results.clone()),
            records: HashMap::new(),
            listed: Vec::new(),
            settings,
            thread,
            results,
        }
    }

    /// Applies a configuration: servers that it no longer lists are removed.
    pub fn apply(&mut self, config: &SessionConfig) {
        let settings = ProbeSettings::new(config);
        if std::mem::replace(&mut self.settings, settings) != settings {
            self.monitors = monitors(&self.thread, settings, self.results.clone());
            self.records.keys().for_each(|server| self.monitors.add(server.clone()));
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
        for server in &self.listed {
            if let Entry::Vacant(entry) = self.records.entry(server.clone()) {
                self.fleet.add(server.clone());
                self.monitors.add(server.clone());
                entry.insert(ServerRecord::new(server.clone(), config.drained_servers.contains(server)));
            }
        }
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

/// No monitors yet; they run on this thread.
fn monitors(thread: &Arbiter, settings: ProbeSettings, results: Recipient<ProbeResult>) -> Monitors {
    let (thread, tls) = (thread.handle(), tls::client_config());
    Supervisor::new("monitor of server", move |server: &PublicAddress, mut stopped| {
        let (server, tls, results) = (server.clone(), tls.clone(), results.clone());
        thread.spawn_fn(move || {
            actix_rt::spawn(async move {
                tokio::select! {
                    () = monitor(server, settings, tls, results) => {}
                    _ = stopped.recv() => {}
                }
            });
        });
    })
}
