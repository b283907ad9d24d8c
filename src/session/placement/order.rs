//! The servers that have room, in the order of their effective load: so that a choice among a thousand costs no more than
//! one among ten.
//!
//! An effective load changes only with what happens to its server, and when a placement in flight is given up. So each
//! server is put in its place after whatever happens to it, and again at its next expiry.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

/// Where a server stands: the least goes first. Of equal loads the one that has waited longest for its turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rank {
    pub(super) load: f64,
    pub(super) turn: u64,
}

impl Eq for Rank {}

impl Ord for Rank {
    fn cmp(&self, other: &Self) -> Ordering {
        self.load.total_cmp(&other.load).then(self.turn.cmp(&other.turn))
    }
}

impl PartialOrd for Rank {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The order of a fleet.
#[derive(Debug)]
pub(super) struct Order<Id> {
    /// What is noted of each server: its rank if it has room, and its next expiry.
    noted: BTreeMap<Id, (Option<Rank>, Option<Instant>)>,
    ranked: BTreeSet<(Rank, Id)>,
    expiries: BTreeSet<(Instant, Id)>,
}

impl<Id: Clone + Ord> Order<Id> {
    pub(super) fn new() -> Self {
        Self { noted: BTreeMap::new(), ranked: BTreeSet::new(), expiries: BTreeSet::new() }
    }

    /// Notes where a server stands from now on; without a rank it has no room.
    pub(super) fn put(&mut self, id: &Id, rank: Option<Rank>, expiry: Option<Instant>) {
        let before = self.noted.get(id).copied().unwrap_or_default();
        if before == (rank, expiry) {
            return;
        }
        if before.0 != rank {
            before.0.map(|rank| self.ranked.remove(&(rank, id.clone())));
            rank.map(|rank| self.ranked.insert((rank, id.clone())));
        }
        if before.1 != expiry {
            before.1.map(|at| self.expiries.remove(&(at, id.clone())));
            expiry.map(|at| self.expiries.insert((at, id.clone())));
        }
        self.noted.insert(id.clone(), (rank, expiry));
    }

    /// Forgets a server.
    pub(super) fn remove(&mut self, id: &Id) {
        self.put(id, None, None);
        self.noted.remove(id);
    }

    /// The servers with room, the least loaded first.
    pub(super) fn servers(&self) -> impl Iterator<Item = &Id> {
        self.ranked.iter().map(|(_, id)| id)
    }

    /// The servers whose placements have expired since they were put in their place.
    pub(super) fn expired(&self, now: Instant) -> impl Iterator<Item = &Id> {
        self.expiries.iter().take_while(move |(at, _)| *at <= now).map(|(_, id)| id)
    }

    /// The next expiry after now.
    pub(super) fn next_expiry(&self, now: Instant) -> Option<Instant> {
        self.expiries.iter().map(|(at, _)| *at).find(|at| *at > now)
    }
}
