//! The names of `simulationServers`, and the simulation servers that each resolves to. Part of the registry, which looks
//! all names up every second regardless of TTL.
//!
//! If a lookup fails or returns no records, the last known servers stay.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

use actix_rt::time::timeout;
use futures_util::future::join_all;

use super::resolver::look_up;
use super::server_record::NameStatus;
use crate::session::config::ServerEntry;
use crate::shared::domain::PublicAddress;
use crate::shared::text::excerpt;

/// The simulation servers that a name resolves to, at least one; or why the lookup failed.
pub type LookupResult = Result<BTreeSet<PublicAddress>, String>;

/// The names that are resolved.
#[derive(Default)]
pub struct NameTable(BTreeMap<PublicAddress, ResolvedName>);

/// What a name resolves to, and why its last lookup failed, if it did.
#[derive(Default)]
struct ResolvedName {
    servers: BTreeSet<PublicAddress>,
    error: Option<String>,
}

/// Longest error text that is kept, in characters.
const MAX_ERROR_LENGTH: usize = 120;

/// Resolves names to simulation servers, all at the same time.
pub async fn look_up_all(names: Vec<PublicAddress>) -> Vec<(PublicAddress, LookupResult)> {
    let found = join_all(names.iter().map(servers)).await;
    names.into_iter().zip(found).collect()
}

async fn servers(name: &PublicAddress) -> LookupResult {
    // One timeout for all attempts of the resolver, because they delay the results of the other names.
    let addresses = timeout(Duration::from_secs(2), look_up(name.host()))
        .await
        .map_err(|_| "timed out".to_owned())??;
    addresses
        .into_iter()
        .map(|address| SocketAddr::new(address, name.port()).to_string().parse())
        .collect()
}

impl NameTable {
    /// Keeps exactly the names among these entries.
    pub fn apply(&mut self, entries: &[ServerEntry]) {
        let mut before = std::mem::take(&mut self.0);
        for name in entries.iter().filter_map(ServerEntry::name) {
            self.0.insert(name.clone(), before.remove(name).unwrap_or_default());
        }
    }

    /// All names.
    pub fn names(&self) -> Vec<PublicAddress> {
        self.0.keys().cloned().collect()
    }

    /// Records lookups; names that are no longer listed are ignored. Returns whether some name resolves to other servers
    /// than before.
    pub fn record(&mut self, answers: Vec<(PublicAddress, LookupResult)>) -> bool {
        let mut has_moved = false;
        for (name, answer) in answers {
            let Some(known) = self.0.get_mut(&name) else { continue };
            match answer {
                Ok(found) => {
                    if known.error.take().is_some() {
                        log::info!("dns+{name}: can be looked up again");
                    }
                    if found != known.servers {
                        log::info!("dns+{name}: leads to other servers than before: {}", found.len());
                        known.servers = found;
                        has_moved = true;
                    }
                }
                Err(error) => {
                    let error = excerpt(&error, MAX_ERROR_LENGTH);
                    if known.error.is_none() {
                        log::warn!("dns+{name}: can't be looked up: {error}; the servers that it led to before stay");
                    }
                    known.error = Some(error);
                }
            }
        }
        has_moved
    }

    /// The servers of these entries, in their order, without duplicates.
    pub fn servers(&self, entries: &[ServerEntry]) -> Vec<PublicAddress> {
        let mut seen = BTreeSet::new();
        let mut servers = Vec::new();
        for entry in entries {
            let found = entry
                .name()
                .and_then(|name| self.0.get(name))
                .into_iter()
                .flat_map(|known| &known.servers);
            servers.extend(
                entry
                    .server()
                    .into_iter()
                    .chain(found)
                    .filter(|server| seen.insert(*server))
                    .cloned(),
            );
        }
        servers
    }

    /// What is known of each name.
    pub fn status(&self) -> Vec<NameStatus> {
        let status = |(name, known): (&PublicAddress, &ResolvedName)| NameStatus {
            name: format!("dns+{name}"),
            servers: known.servers.len(),
            error: known.error.clone(),
        };
        self.0.iter().map(status).collect()
    }
}
