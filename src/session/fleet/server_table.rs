//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.
//!
//! A server that no name resolves to any more gets no clients. It is monitored as long as it answers, because a name
//! may resolve to it again, and so that its clients stay visible until they have left.

use std::collections::{BTreeSet, HashMap};

use super::fleet_status::NameStatus;
use super::monitors::Monitors;
use super::name_monitor::LookupResult;
use super::name_table::{NameChange, NameTable};
use super::server_monitor::ProbeSettings;
use super::server_record::ServerRecord;
use crate::session::config::SessionConfig;
use crate::shared::domain::PublicAddress;

/// All servers and names, with their monitors.
pub struct ServerTable {
    monitors: Monitors,
    names: NameTable,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    watched: HashMap<PublicAddress, ServerRecord>,
}

/// The difference between two lists of servers.
#[derive(Debug, Default)]
pub struct ListChange {
    /// Servers that are monitored from now on.
    pub added: Vec<PublicAddress>,
    /// Servers that are no longer monitored.
    pub gone: Vec<PublicAddress>,
    /// Servers that a name resolves to again, or no longer.
    pub turned: Vec<PublicAddress>,
}

impl ServerTable {
    /// No servers yet.
    pub fn new(monitors: Monitors) -> Self {
        Self { monitors, names: NameTable::default(), listed: Vec::new(), watched: HashMap::new() }
    }

    /// Applies a configuration: servers that it no longer lists are removed.
    pub fn apply(&mut self, config: &SessionConfig) -> ListChange {
        self.monitors.set_probes(ProbeSettings::new(config));
        self.names.apply(&config.simulation_servers, &mut self.monitors);
        self.list(config, true)
    }

    /// Applies changed names: a server that no name resolves to any more is removed if it does not answer.
    pub fn follow_names(&mut self, config: &SessionConfig) -> ListChange {
        self.list(config, false)
    }

    fn list(&mut self, config: &SessionConfig, at_once: bool) -> ListChange {
        let mut change = ListChange::default();
        self.listed = self.names.servers(&config.simulation_servers);
        let listed: BTreeSet<&PublicAddress> = self.listed.iter().collect();
        for (server, record) in &mut self.watched {
            let unlisted = !listed.contains(server);
            let turned = std::mem::replace(&mut record.unlisted, unlisted) != unlisted;
            record.drained = config.drained_servers.contains(server);
            if unlisted && (at_once || record.current().is_none()) {
                change.gone.push(server.clone());
            } else if turned {
                change.turned.push(server.clone());
            }
        }
        for server in self.listed.iter().filter(|server| !self.watched.contains_key(*server)) {
            change.added.push(server.clone());
        }
        for server in &change.gone {
            self.forget(server);
        }
        for server in &change.added {
            self.monitors.watch(server);
            self.watched.insert(server.clone(), ServerRecord::new(config.drained_servers.contains(server)));
        }
        change
    }

    /// Removes a server and stops its monitor.
    pub fn forget(&mut self, server: &PublicAddress) {
        if self.watched.remove(server).is_some() {
            log::info!("{server}: no longer watched");
            self.monitors.unwatch(server);
        }
    }

    /// Records a lookup; `None` if the name is no longer listed.
    pub fn record_lookup(&mut self, result: LookupResult) -> Option<NameChange> {
        self.names.record(result)
    }

    /// The monitors of servers and names.
    pub fn monitors(&mut self) -> &mut Monitors {
        &mut self.monitors
    }

    /// What is known of a server.
    pub fn get(&self, server: &PublicAddress) -> Option<&ServerRecord> {
        self.watched.get(server)
    }

    /// The mutable record of a server.
    pub fn get_mut(&mut self, server: &PublicAddress) -> Option<&mut ServerRecord> {
        self.watched.get_mut(server)
    }

    /// What is known of all servers.
    pub fn records(&self) -> impl Iterator<Item = &ServerRecord> {
        self.watched.values()
    }

    /// All servers in the order of the configuration; those that are no longer listed come last.
    pub fn in_order(&self) -> impl Iterator<Item = &PublicAddress> {
        let unlisted = self.watched.iter().filter(|(_, record)| record.unlisted);
        let unlisted: BTreeSet<_> = unlisted.map(|(server, _)| server).collect();
        self.listed.iter().chain(unlisted)
    }

    /// What is known of each name.
    pub fn names(&self) -> Vec<NameStatus> {
        self.names.status()
    }
}
