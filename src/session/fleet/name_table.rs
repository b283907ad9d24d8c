//! The names of `simulationServers`, and the simulation servers that each resolves to. Part of the registry, which looks
//! each name up every second regardless of TTL.
//!
//! If a lookup fails or returns no records, the last known servers stay.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::SystemTime;

use super::fleet_status::NameStatus;
use super::resolver::look_up;
use crate::session::config::{DnsName, ServerEntry};
use crate::shared::domain::PublicAddress;
use crate::shared::text::excerpt;

/// The simulation servers that a name resolves to, at least one; or why the lookup failed.
pub type LookupResult = Result<BTreeSet<PublicAddress>, String>;

/// The names that are resolved.
#[derive(Default)]
pub struct NameTable(BTreeMap<DnsName, ResolvedName>);

/// One name.
struct ResolvedName {
    servers: BTreeSet<PublicAddress>,
    status: NameStatus,
    /// Whether a lookup is in progress.
    is_looked_up: bool,
}

/// Longest error text that is kept, in characters.
const MAX_ERROR_LENGTH: usize = 120;

/// Resolves a name to simulation servers.
pub async fn servers(name: DnsName) -> LookupResult {
    let addresses = look_up(&name.host).await?;
    let servers = addresses.into_iter().map(|address| SocketAddr::new(address, name.port).to_string().parse());
    servers.collect()
}

impl NameTable {
    /// Keeps exactly the names among these entries.
    pub fn apply(&mut self, entries: &[ServerEntry]) {
        let mut before = std::mem::take(&mut self.0);
        for name in entries.iter().filter_map(ServerEntry::name) {
            let known = before.remove(name).unwrap_or_else(|| ResolvedName {
                servers: BTreeSet::new(),
                status: NameStatus { name: name.to_string(), servers: 0, error: None, since: SystemTime::now() },
                is_looked_up: false,
            });
            self.0.insert(name.clone(), known);
        }
    }

    /// The names that are not being looked up. The caller looks them up and reports it by [`Self::record`].
    pub fn due(&mut self) -> Vec<DnsName> {
        let due = |(name, known): (&DnsName, &mut ResolvedName)| {
            (!std::mem::replace(&mut known.is_looked_up, true)).then(|| name.clone())
        };
        self.0.iter_mut().filter_map(due).collect()
    }

    /// Records a lookup, unless the name is no longer listed. Returns whether it resolves to other servers than before;
    /// and the new status, if lookups have begun to fail, or to succeed again.
    pub fn record(&mut self, name: &DnsName, answer: LookupResult) -> Option<(bool, Option<NameStatus>)> {
        let ResolvedName { servers, status, is_looked_up } = self.0.get_mut(name)?;
        *is_looked_up = false;
        let failed_before = status.error.take().is_some();
        let mut has_moved = false;
        match answer {
            Ok(found) => {
                let (new, gone) = (found.difference(servers).count(), servers.difference(&found).count());
                has_moved = new + gone > 0;
                if has_moved {
                    log::info!("{name}: leads to other servers: {new} new, {gone} gone");
                }
                (status.servers, *servers) = (found.len(), found);
            }
            Err(error) => status.error = Some(excerpt(&error, MAX_ERROR_LENGTH)),
        }
        let has_turned = failed_before != status.error.is_some();
        if has_turned {
            status.since = SystemTime::now();
        }
        Some((has_moved, has_turned.then(|| status.clone())))
    }

    /// The servers of these entries, in their order, without duplicates.
    pub fn servers(&self, entries: &[ServerEntry]) -> Vec<PublicAddress> {
        let mut seen = BTreeSet::new();
        let mut servers = Vec::new();
        for entry in entries {
            let found = entry.name().and_then(|name| self.0.get(name)).into_iter().flat_map(|known| &known.servers);
            servers.extend(entry.server().into_iter().chain(found).filter(|server| seen.insert(*server)).cloned());
        }
        servers
    }

    /// What is known of each name.
    pub fn status(&self) -> Vec<NameStatus> {
        self.0.values().map(|known| known.status.clone()).collect()
    }
}
