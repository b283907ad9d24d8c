//! The monitored simulation servers: those of the configuration, and those that its names resolve to. Part of the
//! registry.

use std::collections::HashMap;
use std::sync::Arc;

use actix::prelude::*;
use actix_rt::ArbiterHandle;
use rustls::ClientConfig;

use super::name_table::NameTable;
use super::refusal::refusal;
use super::server_monitor::{Ask, GetRecords, Parent, ServerMonitor, Stop};
use super::server_record::ServerRecord;
use super::slot_link::{LinkChange, LinkEvent};
use crate::session::config::SessionConfig;
use crate::session::line::Terms;
use crate::session::placement::{LoadBalancer, ReadyWorlds};
use crate::shared::domain::{
    Admission, Failure, KeepReady, Load, ProjectUrl, PublicAddress, ToSimulationServer, Wishes,
};
use crate::shared::http::tls;
use crate::shared::run::permanent::PanicCounter;

/// All servers and names, with the servers' monitors.
pub struct ServerTable {
    /// The names of the configuration that are resolved.
    pub names: NameTable,
    /// What is known of placing clients on the servers.
    pub fleet: LoadBalancer<PublicAddress>,
    /// What they keep ready for clients.
    pub ready: ReadyWorlds<PublicAddress>,
    /// The actors that probe the servers, one for each.
    monitors: HashMap<PublicAddress, Addr<ServerMonitor>>,
    /// Counts the panics of all of them.
    panics: PanicCounter,
    /// What is known of each server.
    pub records: HashMap<PublicAddress, ServerRecord>,
    /// In the order of the configuration.
    listed: Vec<PublicAddress>,
    tls: Option<Arc<ClientConfig>>,
    /// The thread of the monitors, so that requests of clients do not wait for them.
    thread: ArbiterHandle,
    parent: Parent,
}

impl ServerTable {
    /// No servers yet; their monitors will run on this thread, and `parent` receives what they find.
    pub fn new(config: &Arc<SessionConfig>, thread: ArbiterHandle, parent: Parent) -> Self {
        Self {
            names: NameTable::default(),
            fleet: LoadBalancer::new(config.policy()),
            ready: ReadyWorlds::default(),
            monitors: HashMap::new(),
            panics: PanicCounter::default(),
            records: HashMap::new(),
            listed: Vec::new(),
            tls: None,
            thread,
            parent,
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
            if let Some(monitor) = self.monitors.remove(&server) {
                monitor.do_send(Stop);
            }
            self.fleet.remove(&server);
            self.ready.lose(&server);
        }
    }

    /// Starts the monitor of a server, replacing one that runs.
    fn start_monitor(&mut self, server: PublicAddress, config: &Arc<SessionConfig>) {
        let key = server.clone();
        let config = Arc::clone(config);
        let tls = self.tls.clone();
        let parent = self.parent.clone();
        // That of an earlier monitor.
        parent.links.do_send(LinkEvent {
            server: server.clone(),
            change: LinkChange::Down,
        });
        let monitor =
            ServerMonitor::start_in_arbiter(&self.thread, move |_| ServerMonitor::new(server, &config, tls, parent));
        if let Some(before) = self.monitors.insert(key, monitor) {
            before.do_send(Stop);
        }
    }

    /// Starts a new monitor for each server whose monitor has panicked: actix does not restart it.
    pub fn restart_monitors(&mut self, config: &Arc<SessionConfig>) {
        let is_gone =
            |(server, monitor): (&PublicAddress, &Addr<ServerMonitor>)| (!monitor.connected()).then(|| server.clone());
        let gone: Vec<PublicAddress> = self.monitors.iter().filter_map(is_gone).collect();
        for server in gone {
            self.panics.count(&format!("monitor of server {server}"));
            self.start_monitor(server, config);
        }
    }

    /// Why no server takes a client for this world, if it names one.
    pub fn refusal(&self, world: Option<&ProjectUrl>) -> Failure {
        let load = |record: &ServerRecord| Load::try_from(self.fleet.effective_load(&record.address)?).ok();
        let servers = self.records.values();
        refusal(servers.map(|record| (record, load(record))), world)
    }

    /// Tells a server who waits for its slots.
    pub fn ask(&self, server: &PublicAddress, wishes: Wishes) {
        if let Some(monitor) = self.monitors.get(server) {
            monitor.do_send(Ask(ToSimulationServer::Wishes(wishes)));
        }
    }

    /// Tells a server what to keep ready.
    pub fn keep_ready(&self, server: &PublicAddress, list: KeepReady) {
        if let Some(monitor) = self.monitors.get(server) {
            monitor.do_send(Ask(ToSimulationServer::KeepReady(list)));
        }
    }

    /// The monitors of all servers, for requests of records.
    pub fn monitors(&self) -> Vec<(PublicAddress, Recipient<GetRecords>)> {
        let monitors = self.monitors.iter();
        monitors
            .map(|(server, monitor)| (server.clone(), monitor.clone().recipient()))
            .collect()
    }

    /// The addresses of all servers, in the order of the configuration.
    pub fn addresses(&self) -> &[PublicAddress] {
        &self.listed
    }

    /// What is known of all servers, in the order of the configuration.
    pub fn in_order(&self) -> impl Iterator<Item = &ServerRecord> {
        self.listed.iter().filter_map(|server| self.records.get(server))
    }
}

/// On what terms a server takes a client for a world at a load, in percent, by its last report; `None` if it does not.
pub fn admission(
    records: &HashMap<PublicAddress, ServerRecord>,
) -> impl Fn(&PublicAddress, &ProjectUrl, f64) -> Option<Admission> {
    |server, world, load| {
        let answer = records.get(server)?.state.last_answer()?;
        answer.report.check(world, Load::try_from(load).ok()?).ok()
    }
}

/// On what terms a server takes a client for a world, by its last report.
pub fn terms(records: &HashMap<PublicAddress, ServerRecord>) -> impl Fn(&PublicAddress, &ProjectUrl) -> Option<Terms> {
    |server, world| {
        let report = &records.get(server)?.state.last_answer()?.report;
        Some(Terms {
            admission: report.check(world, Load::ZERO).ok()?,
            is_open: report.check(world, report.load).is_ok(),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::session::fleet::server_monitor::ProbeResult;

    /// A monitor that receives this panics.
    #[derive(Message)]
    #[rtype(result = "()")]
    struct Panic;

    impl Handler<Panic> for ServerMonitor {
        type Result = ();

        fn handle(&mut self, _: Panic, _: &mut Self::Context) {
            // Panics without printing.
            std::panic::resume_unwind(Box::new("a test has asked for it"));
        }
    }

    /// Takes the results of the monitors.
    struct Found(tokio::sync::mpsc::UnboundedSender<PublicAddress>);

    impl Actor for Found {
        type Context = Context<Self>;
    }

    impl Handler<ProbeResult> for Found {
        type Result = ();

        fn handle(&mut self, result: ProbeResult, _: &mut Self::Context) {
            self.0.send(result.server).unwrap();
        }
    }

    impl Handler<LinkEvent> for Found {
        type Result = ();

        fn handle(&mut self, _: LinkEvent, _: &mut Self::Context) {}
    }

    #[actix_rt::test]
    async fn a_monitor_that_panics_is_started_again_and_disturbs_no_other() {
        let (sender, mut probed) = tokio::sync::mpsc::unbounded_channel();
        // Nothing listens there, which is a result, too.
        let config: SessionConfig =
            serde_json::from_str(r#"{"simulationServers": ["127.0.0.1:1", "127.0.0.1:2"], "loadRefresh": 0.1}"#)
                .unwrap();
        let config = Arc::new(config);
        let found = Found(sender).start();
        let parent = Parent {
            probes: found.clone().recipient(),
            links: found.recipient(),
            roster: Arc::default(),
        };
        let mut table = ServerTable::new(&config, Arbiter::current(), parent);
        table.apply(&config);
        let first: PublicAddress = "127.0.0.1:1".parse().unwrap();
        let second: PublicAddress = "127.0.0.1:2".parse().unwrap();
        let mut until_probed = async |server: &PublicAddress| {
            let found = async { while probed.recv().await.unwrap() != *server {} };
            tokio::time::timeout(Duration::from_secs(20), found).await.unwrap();
        };
        until_probed(&first).await;
        let old = table.monitors[&first].clone();
        let other = table.monitors[&second].clone();
        old.send(Panic).await.unwrap_err();
        // A panic ends the actor; its answer may come a moment earlier.
        let ended = async {
            while old.connected() {
                tokio::task::yield_now().await;
            }
        };
        tokio::time::timeout(Duration::from_secs(20), ended).await.unwrap();
        table.restart_monitors(&config);
        // Its first probe, and one of its schedule.
        until_probed(&first).await;
        until_probed(&second).await;
        until_probed(&first).await;
        assert!(table.monitors[&first].connected());
        assert!(table.monitors[&second] == other && other.connected());
    }
}
