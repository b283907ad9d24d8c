//! The servers of the fleet, and the choice between them.

use super::cost::{Common, Estimate};
use super::server::{Report, Server};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// What the owner of a fleet can set.
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    /// A server takes clients while its effective load is under this, in percent. Default: 95.
    pub threshold: f64,
    /// What a client is expected to cost until a server's reports teach better, in percent. Default: 2.
    pub initial_cost: f64,
    /// How long a placement counts whose client does not come. Default: 15 seconds.
    pub patience: Duration,
    /// How long it takes until a client that came shows fully in the reported load, which is a mean of five seconds, and a
    /// simulation needs a while to start. Default: 8 seconds.
    pub settling: Duration,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            threshold: 95.0,
            initial_cost: 2.0,
            patience: Duration::from_secs(15),
            settling: Duration::from_secs(8),
        }
    }
}

/// The simulation servers, what is known of each, and the choice between them. `Id` is whatever the owner knows a server
/// by.
///
/// ```
/// use std::time::Instant;
/// use webots_fleet::session::placement::{Fleet, Policy, Report};
///
/// let now = Instant::now();
/// let mut fleet = Fleet::new(Policy::default());
/// for (id, load) in [("busy", 40.0), ("idle", 3.0)] {
///     fleet.add(id);
///     fleet.report(&id, now, Report { load, instances: None });
/// }
/// assert_eq!(fleet.place(now, |_| true), Some("idle"));
/// assert_eq!(fleet.effective_load(&"idle", now), Some(5.0));
/// ```
#[derive(Debug)]
pub struct Fleet<Id> {
    policy: Policy,
    servers: BTreeMap<Id, Server>,
    common: Common,
    turns: u64,
}

impl<Id: Clone + Ord> Fleet<Id> {
    /// A fleet without servers.
    #[must_use]
    pub fn new(policy: Policy) -> Self {
        Self {
            policy,
            servers: BTreeMap::new(),
            common: Common::new(),
            turns: 0,
        }
    }

    /// Changes the policy for all that follows. `initial_cost` applies to servers that are added later.
    pub fn set_policy(&mut self, policy: Policy) {
        self.policy = policy;
    }

    /// Adds a server, which is down until its first report. One that is there already stays as it is.
    pub fn add(&mut self, id: Id) {
        self.turns += 1;
        self.servers
            .entry(id)
            .or_insert_with(|| Server::new(&self.policy, self.turns));
    }

    /// Removes a server and all that was known of it.
    pub fn remove(&mut self, id: &Id) {
        if let Some(server) = self.servers.remove(id) {
            self.common.replace(server.estimate(), Estimate::default());
        }
    }

    /// A server answered at `now`. Says nothing of a server that is not in the fleet.
    pub fn report(&mut self, id: &Id, now: Instant, report: Report) {
        if let Some(server) = self.servers.get_mut(id) {
            server.report(now, report, &self.policy, &mut self.common);
        }
    }

    /// A server does not answer: it takes no clients until its next report.
    pub fn lose(&mut self, id: &Id) {
        if let Some(server) = self.servers.get_mut(id) {
            server.lose();
        }
    }

    /// Chooses the server of least effective load among those that have room and are `eligible`, and counts the client as
    /// sent there. Of equal servers the one is taken that has waited longest for its turn.
    pub fn place(&mut self, now: Instant, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        let policy = &self.policy;
        let mut best: Option<(f64, &Id, &mut Server)> = None;
        for (id, server) in &mut self.servers {
            if let Some(load) = server.effective_load_if_room(now, policy)
                && best
                    .as_ref()
                    .is_none_or(|(least, _, first)| (load, server.turn) < (*least, first.turn))
                && eligible(id)
            {
                best = Some((load, id, server));
            }
        }
        let (_, id, server) = best?;
        self.turns += 1;
        server.place(now, self.turns, policy);
        Some(id.clone())
    }

    /// Whether some server can take a client.
    #[must_use]
    pub fn available(&self, now: Instant) -> bool {
        self.servers
            .values()
            .any(|server| server.effective_load_if_room(now, &self.policy).is_some())
    }

    /// When placements are given up next: the one moment at which availability can change without a call to this fleet.
    #[must_use]
    pub fn next_change(&self, now: Instant) -> Option<Instant> {
        self.servers
            .values()
            .filter_map(|server| server.next_expiry(now, &self.policy))
            .min()
    }

    /// The load that a server will have once all that was sent to it shows, in percent; `None` if it is down.
    #[must_use]
    pub fn effective_load(&self, id: &Id, now: Instant) -> Option<f64> {
        self.servers.get(id)?.effective_load(now, &self.policy)
    }

    /// How many clients have been sent to a server and not been seen there yet.
    #[must_use]
    pub fn in_flight(&self, id: &Id, now: Instant) -> usize {
        self.servers
            .get(id)
            .map_or(0, |server| server.in_flight(now, &self.policy))
    }

    /// What a client is expected to cost a server, in percent; `None` if the fleet does not have that server.
    #[must_use]
    pub fn learned_cost(&self, id: &Id) -> Option<f64> {
        self.servers.get(id).map(Server::learned_cost)
    }

    /// The mean of the last reported loads of the servers that are up, in percent; `None` if none is.
    #[must_use]
    pub fn mean_load(&self) -> Option<f64> {
        let mut count = 0_u32;
        let mut sum = 0.0;
        for load in self.servers.values().filter_map(Server::load) {
            count += 1;
            sum += load;
        }
        (count > 0).then(|| sum / f64::from(count))
    }
}
