//! The simulation servers that are watched: those of the configuration, and those that its names lead to. Part of the
//! registry.
//!
//! A server that no name leads to any more gets no clients. It is watched for as long as it answers, for it may be listed
//! again, and its clients are to be seen until they are gone.

use std::collections::{BTreeSet, HashMap};

use hickory_resolver::TokioResolver;

use super::fleet_status::NameStatus;
use super::monitors::{MonitorRecipients, Monitors};
use super::name_monitor::LookupResult;
use super::name_table::{NameChange, NameTable};
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

/// How another list of servers differs from the one before.
#[derive(Debug, Default)]
pub struct ListChange {
    /// These are watched from now on.
    pub added: Vec<PublicAddress>,
    /// These are forgotten.
    pub gone: Vec<PublicAddress>,
    /// A name leads to these again, or no longer.
    pub turned: Vec<PublicAddress>,
}

impl ServerTable {
    /// No servers yet.
    pub fn new(resolver: TokioResolver) -> Self {
        Self {
            monitors: Monitors::new(resolver),
            names: NameTable::default(),
            listed: Vec::new(),
            watched: HashMap::new(),
        }
    }

    /// Follows a configuration: what it no longer lists is forgotten.
    pub fn apply(&mut self, config: &SessionConfig, results: &MonitorRecipients) -> ListChange {
        self.names.apply(&config.simulation_servers, &mut self.monitors, results);
        self.list(config, results, true)
    }

    /// Follows the names: what no name leads to any more is forgotten if it does not answer.
    pub fn follow_names(&mut self, config: &SessionConfig, results: &MonitorRecipients) -> ListChange {
        self.list(config, results, false)
    }

    fn list(&mut self, config: &SessionConfig, results: &MonitorRecipients, at_once: bool) -> ListChange {
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
            self.monitors.watch(server, config, results);
            self.watched.insert(server.clone(), ServerRecord::new(config.drained_servers.contains(server)));
        }
        change
    }

    /// Ends the watch on a server.
    pub fn forget(&mut self, server: &PublicAddress) {
        if self.watched.remove(server).is_some() {
            log::info!("{server}: no longer watched");
            self.monitors.unwatch(server);
        }
    }

    /// Takes in what a lookup brought; nothing comes back for a name that is no longer listed.
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

    /// The same, to be changed.
    pub fn get_mut(&mut self, server: &PublicAddress) -> Option<&mut ServerRecord> {
        self.watched.get_mut(server)
    }

    /// What is known of all servers.
    pub fn records(&self) -> impl Iterator<Item = &ServerRecord> {
        self.watched.values()
    }

    /// All servers in the order of the configuration; last those that are listed no longer.
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
