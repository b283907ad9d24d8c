//! Why clients got no simulation or lost it, and at which simulation servers. Pure.

use std::collections::{BTreeMap, BTreeSet};

use crate::visit::Visit;

/// So many simulation servers are named with a reason; of more the number is.
const MOST_NAMED: usize = 3;

/// How often each reason was met, apart for those that a simulation server is to blame for, and those servers.
#[derive(Default)]
pub(crate) struct Reasons<'visits>(BTreeMap<(&'visits str, bool), (u32, BTreeSet<&'visits str>)>);

impl<'visits> Reasons<'visits> {
    /// A client has met a reason: at the simulation server that it was sent to, if it was.
    pub(crate) fn add(&mut self, why: &'visits str, visit: &'visits Visit) {
        let why = why.trim_end_matches('.');
        // Some reasons name their server themselves.
        let server = visit.server.as_deref().filter(|server| !why.contains(server));
        let (count, servers) = self.0.entry((why, server.is_some())).or_default();
        *count += 1;
        servers.extend(server);
    }

    /// Each reason in words, with its servers, and how often it was met.
    pub(crate) fn told(self) -> BTreeMap<String, u32> {
        let told = |((why, _), (count, servers)): (_, (u32, BTreeSet<&str>))| {
            let named: Vec<&str> = servers.into_iter().collect();
            let place = match named.len() {
                0 => String::new(),
                1..=MOST_NAMED => format!(" at {}", named.join(", ")),
                many => format!(" at {many} simulation servers"),
            };
            (format!("{why}{place}"), count)
        };
        self.0.into_iter().map(told).collect()
    }
}
