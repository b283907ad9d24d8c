//! What the fleet keeps ready: the lists of the configuration and of `POST /ready`, and the share of each simulation
//! server. Part of the registry.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use tokio::sync::watch;

use super::server_record::ServerState;
use super::server_table::{ServerTable, admission};
use super::slot_link::{LinkChange, LinkEvent};
use crate::session::config::SessionConfig;
use crate::session::placement::shares;
use crate::shared::domain::{KeepReady, Load, ProjectUrl, PublicAddress, ReadyCount, ReadyEntry, View};

/// The lists, and what each server was asked for.
pub(super) struct ReadyShares {
    /// The entries of `POST /ready`.
    requested: watch::Receiver<Vec<ReadyEntry>>,
    /// The servers that keep simulations ready on request, with what they were asked for last.
    asked: HashMap<PublicAddress, Option<Vec<ReadyCount>>>,
    shared: Instant,
}

/// Interval between two looks at what is wanted.
const INTERVAL: Duration = Duration::from_secs(1);

impl ReadyShares {
    pub(super) fn new(requested: watch::Receiver<Vec<ReadyEntry>>) -> Self {
        Self {
            requested,
            asked: HashMap::new(),
            shared: Instant::now(),
        }
    }

    /// The entries of `POST /ready`.
    pub(super) fn requested(&self) -> Vec<ReadyEntry> {
        self.requested.borrow().clone()
    }

    /// How many of each listed world the fleet is to keep ready now.
    pub(super) fn wanted(&self, config: &SessionConfig) -> Vec<ReadyCount> {
        let now = Timestamp::now();
        let requested = self.requested.borrow();
        let mut wanted: BTreeMap<(&ProjectUrl, View), u32> = BTreeMap::new();
        for entry in config
            .ready
            .iter()
            .chain(requested.iter())
            .filter(|entry| !entry.is_over(now))
        {
            let most = wanted.entry((&entry.world, entry.mode)).or_default();
            *most = if entry.is_due(now) {
                entry.count.max(*most)
            } else {
                *most
            };
        }
        let count = |((world, mode), count): ((&ProjectUrl, View), u32)| ReadyCount {
            world: world.clone(),
            mode,
            count,
        };
        wanted.into_iter().map(count).collect()
    }

    /// Something has happened to the link of a server.
    pub(super) fn link(&mut self, LinkEvent { server, change }: &LinkEvent) {
        match change {
            LinkChange::Up(hello) if hello.keeps_ready => drop(self.asked.insert(server.clone(), None)),
            LinkChange::Up(_) | LinkChange::Down | LinkChange::Failed => drop(self.asked.remove(server)),
            LinkChange::Offers(_) => {}
        }
    }

    /// Tells each server its share, if that has changed. One that does not answer or drains gets none.
    pub(super) fn tick(&mut self, servers: &ServerTable, config: &SessionConfig) {
        if self.shared.elapsed() < INTERVAL {
            return;
        }
        self.shared = Instant::now();
        self.asked.retain(|server, _| servers.records.contains_key(server));
        let slots = |server: &PublicAddress| match &servers.records.get(server)?.state {
            ServerState::Answering { answer, .. } if !answer.report.draining => answer.report.instances,
            _ => None,
        };
        let may_keep = servers.addresses().iter().filter(|server| {
            self.asked.contains_key(server) && !servers.records.get(server).is_some_and(|record| record.drained)
        });
        let rooms: Vec<(PublicAddress, u32)> = may_keep
            .filter_map(|server| Some((server.clone(), slots(server)?.slots)))
            .collect();
        // At any load: a server that only shares idle time keeps its share while it is busy.
        let admission = admission(&servers.records);
        let accepts =
            |server: &PublicAddress, world: &ProjectUrl| admission(server, world, Load::ZERO.percent()).is_some();
        let lists = shares(&self.wanted(config), &rooms, accepts);
        let mut lists: HashMap<PublicAddress, Vec<ReadyCount>> =
            rooms.into_iter().map(|(server, _)| server).zip(lists).collect();
        for (server, asked) in &mut self.asked {
            let list = lists.remove(server).unwrap_or_default();
            if asked.as_ref() != Some(&list) {
                servers.keep_ready(
                    server,
                    KeepReady {
                        keep_ready: list.clone(),
                    },
                );
                *asked = Some(list);
            }
        }
    }
}
