//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.
//!
//! A server that no name resolves to any more gets no clients. It is monitored as long as it answers, because a name
//! may resolve to it again, and so that its clients stay visible until they have left.

use std::collections::{BTreeSet, HashMap};

use actix::prelude::*;

use super::name_table::NameTable;
use super::server_monitor::{ProbeResult, ProbeSettings, ServerMonitor, Stop};
use super::server_record::ServerRecord;
use crate::session::config::SessionConfig;
use crate::shared::domain::PublicAddress;
use crate::shared::http::tls;
use crate::shared::run::Supervisor;

/// All servers and names, with the servers' monitors.
pub struct ServerTable {
    /// The names of the configuration that are resolved.
    pub names: NameTable,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    watched: HashMap<PublicAddress, ServerRecord>,
    settings: ProbeSettings,
    monitors: Supervisor<PublicAddress, ServerMonitor>,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: Arbiter,
    results: Recipient<ProbeResult>,
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
    /// No servers yet; `results` receives each probe.
    pub fn new(config: &SessionConfig, results: Recipient<ProbeResult>) -> Self {
        let (settings, thread) = (ProbeSettings::new(config), Arbiter::new());
        let monitors = monitors(&thread, settings, results.clone());
        let (names, listed, watched) = (NameTable::default(), Vec::new(), HashMap::new());
        Self { names, listed, watched, settings, monitors, thread, results }
    }

    /// Applies a configuration: servers that it no longer lists are removed.
    pub fn apply(&mut self, config: &SessionConfig) -> ListChange {
        let settings = ProbeSettings::new(config);
        if std::mem::replace(&mut self.settings, settings) != settings {
            self.monitors.all().for_each(|monitor| monitor.do_send(Stop));
            self.monitors = monitors(&self.thread, settings, self.results.clone());
            self.watched.keys().for_each(|server| self.monitors.add(server.clone()));
        }
        self.names.apply(&config.simulation_servers);
        self.list(config, true)
    }

    /// Replaces monitors that have panicked.
    ///
    /// # Errors
    /// When there were too many panics.
    pub fn restart_gone(&mut self) -> Result<(), String> {
        self.monitors.restart_gone()
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
            self.monitors.add(server.clone());
            self.watched.insert(server.clone(), ServerRecord::new(config.drained_servers.contains(server)));
        }
        change
    }

    /// Removes a server and stops its monitor.
    pub fn forget(&mut self, server: &PublicAddress) {
        if self.watched.remove(server).is_some() {
            log::info!("{server}: no longer watched");
            if let Some(monitor) = self.monitors.remove(server) {
                monitor.do_send(Stop);
            }
        }
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
}

/// No monitors yet; they run on this thread.
fn monitors(
    thread: &Arbiter,
    settings: ProbeSettings,
    results: Recipient<ProbeResult>,
) -> Supervisor<PublicAddress, ServerMonitor> {
    let (thread, tls) = (thread.handle(), tls::client_config());
    Supervisor::new("monitor of server", move |server: &PublicAddress| {
        let (server, tls, results) = (server.clone(), tls.clone(), results.clone());
        let monitor = move |_: &mut Context<ServerMonitor>| ServerMonitor::new(server, settings, tls, results);
        Some(ServerMonitor::start_in_arbiter(&thread, monitor))
    })
}
