//! The names of `simulationServers`, and the simulation servers that each resolves to. Part of the registry.
//!
//! If a lookup fails or returns no records, the last known servers stay.

use std::collections::{BTreeMap, BTreeSet};
use std::time::SystemTime;

use super::fleet_status::NameStatus;
use super::monitors::Monitors;
use super::name_monitor::LookupResult;
use crate::session::config::{DnsName, ServerEntry};
use crate::shared::domain::PublicAddress;
use crate::shared::text::one_line;

/// The names that are resolved.
#[derive(Default)]
pub struct NameTable(BTreeMap<DnsName, MonitoredName>);

/// One name.
struct MonitoredName {
    servers: BTreeSet<PublicAddress>,
    /// Why the last lookup failed, if it did.
    error: Option<String>,
    /// When lookups last began to fail or to succeed.
    since: SystemTime,
}

/// Longest error text that is kept, in characters.
const MAX_ERROR_LENGTH: usize = 120;

/// What a lookup has changed.
#[derive(Debug, PartialEq, Eq)]
pub struct NameChange {
    /// Whether it resolves to other servers than before.
    pub servers: bool,
    /// Whether lookups have begun to fail, or to succeed again.
    pub turn: Option<LookupTransition>,
}

/// Lookups of a name begin to fail, or to succeed again.
#[derive(Debug, PartialEq, Eq)]
pub enum LookupTransition {
    /// They fail, for this reason.
    Fails(String),
    /// They succeed again, with this many servers.
    WorksAgain(usize),
}

impl NameTable {
    /// Monitors exactly the names among these entries.
    pub fn apply(&mut self, entries: &[ServerEntry], monitors: &mut Monitors) {
        let wanted: BTreeSet<&DnsName> = entries.iter().filter_map(ServerEntry::name).collect();
        self.0.retain(|name, _| {
            let stays = wanted.contains(name);
            if !stays {
                monitors.stop_looking_up(name);
            }
            stays
        });
        for name in wanted {
            self.0.entry(name.clone()).or_insert_with(|| {
                monitors.look_up(name);
                MonitoredName { servers: BTreeSet::new(), error: None, since: SystemTime::now() }
            });
        }
    }

    /// Records a lookup. Returns what has changed; `None` if the name is no longer listed.
    pub fn record(&mut self, LookupResult { name, answer }: LookupResult) -> Option<NameChange> {
        let looked = self.0.get_mut(&name)?;
        let failed = looked.error.is_some();
        let mut servers = false;
        let turn = match answer {
            Ok(found) => {
                looked.error = None;
                servers = found != looked.servers;
                looked.servers = found;
                failed.then_some(LookupTransition::WorksAgain(looked.servers.len()))
            }
            Err(error) => {
                let error: String = one_line(&error).chars().take(MAX_ERROR_LENGTH).collect();
                looked.error = Some(error.clone());
                (!failed).then_some(LookupTransition::Fails(error))
            }
        };
        if turn.is_some() {
            looked.since = SystemTime::now();
        }
        Some(NameChange { servers, turn })
    }

    /// The servers of these entries, in their order, without duplicates.
    pub fn servers(&self, entries: &[ServerEntry]) -> Vec<PublicAddress> {
        let mut seen = BTreeSet::new();
        let mut servers = Vec::new();
        for entry in entries {
            let found = entry.name().and_then(|name| self.0.get(name)).into_iter().flat_map(|looked| &looked.servers);
            servers.extend(entry.server().into_iter().chain(found).filter(|server| seen.insert(*server)).cloned());
        }
        servers
    }

    /// What is known of each name.
    pub fn status(&self) -> Vec<NameStatus> {
        let status = |(name, looked): (&DnsName, &MonitoredName)| NameStatus {
            name: name.to_string(),
            servers: looked.servers.len(),
            error: looked.error.clone(),
            since: looked.since,
        };
        self.0.iter().map(status).collect()
    }
}
