//! The simulation servers that are watched: those of the configuration, and those that its names lead to. Part of the
//! registry.
//!
//! A server that no name leads to any more gets no clients. It is watched for as long as it answers, for it may be listed
//! again, and its clients are to be seen until they are gone.

use std::collections::{BTreeSet, HashMap};

use actix::prelude::*;
use hickory_resolver::TokioResolver;

use super::fleet_status::NameStatus;
use super::monitors::{Monitors, Results};
use super::name_monitor::LookupResult;
use super::names::{NameChange, Names};
use super::server_monitor::{ProbeSettings, ServerMonitor, Stop};
use super::server_record::ServerRecord;
use crate::session::config::SessionConfig;
use crate::shared::domain::PublicAddress;

/// All servers and names, with their monitors.
pub struct Servers {
    monitors: Monitors,
    names: Names,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    watched: HashMap<PublicAddress, Watched>,
}

/// One simulation server and its monitor.
struct Watched {
    monitor: Addr<ServerMonitor>,
    record: ServerRecord,
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

impl Servers {
    /// No servers yet.
    #[must_use]
    pub fn new(resolver: TokioResolver) -> Self {
        Self { monitors: Monitors::new(resolver), names: Names::default(), listed: Vec::new(), watched: HashMap::new() }
    }

    /// Follows a configuration: what it no longer lists is forgotten.
    pub fn apply(&mut self, config: &SessionConfig, results: &Results) -> ListChange {
        self.names.apply(&config.simulation_servers, |name| self.monitors.look_up(name, results));
        self.list(config, results, true)
    }

    /// Follows the names: what no name leads to any more is forgotten if it does not answer.
    pub fn follow_names(&mut self, config: &SessionConfig, results: &Results) -> ListChange {
        self.list(config, results, false)
    }

    fn list(&mut self, config: &SessionConfig, results: &Results, at_once: bool) -> ListChange {
        let mut change = ListChange::default();
        self.listed = self.names.servers(&config.simulation_servers);
        let listed: BTreeSet<&PublicAddress> = self.listed.iter().collect();
        for (server, Watched { record, .. }) in &mut self.watched {
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
            let monitor = self.monitors.watch(server, config, results);
            let record = ServerRecord::new(config.drained_servers.contains(server));
            self.watched.insert(server.clone(), Watched { monitor, record });
        }
        change
    }

    /// Ends the watch on a server.
    pub fn forget(&mut self, server: &PublicAddress) {
        if let Some(watched) = self.watched.remove(server) {
            log::info!("{server}: no longer watched");
            watched.monitor.do_send(Stop);
        }
    }

    /// Takes in what a lookup brought; nothing comes back for a name that is no longer listed.
    pub fn record_lookup(&mut self, result: LookupResult) -> Option<NameChange> {
        self.names.record(result)
    }

    /// Starts monitors in place of those that have panicked.
    pub fn restart_gone(&mut self, config: &SessionConfig, results: &Results) {
        for (server, watched) in self.watched.iter_mut().filter(|(_, watched)| !watched.monitor.connected()) {
            log::error!("{server}: its monitor is gone, a new one is started");
            watched.monitor = self.monitors.watch(server, config, results);
        }
        self.names.restart_gone(|name| self.monitors.look_up(name, results));
    }

    /// Changes how servers are probed.
    pub fn set_probes(&self, settings: ProbeSettings) {
        for watched in self.watched.values() {
            watched.monitor.do_send(settings);
        }
    }

    /// What is known of a server.
    #[must_use]
    pub fn get(&self, server: &PublicAddress) -> Option<&ServerRecord> {
        self.watched.get(server).map(|watched| &watched.record)
    }

    /// The same, to be changed.
    pub fn get_mut(&mut self, server: &PublicAddress) -> Option<&mut ServerRecord> {
        self.watched.get_mut(server).map(|watched| &mut watched.record)
    }

    /// What is known of all servers.
    pub fn records(&self) -> impl Iterator<Item = &ServerRecord> {
        self.watched.values().map(|watched| &watched.record)
    }

    /// All servers in the order of the configuration; last those that are listed no longer.
    pub fn in_order(&self) -> impl Iterator<Item = &PublicAddress> {
        let unlisted = self.watched.iter().filter(|(_, watched)| watched.record.unlisted);
        let unlisted: BTreeSet<_> = unlisted.map(|(server, _)| server).collect();
        self.listed.iter().chain(unlisted)
    }

    /// What is known of each name.
    #[must_use]
    pub fn names(&self) -> Vec<NameStatus> {
        self.names.status()
    }
}
