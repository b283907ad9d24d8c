//! The servers that have room, sorted by load, so that a choice among a thousand costs no more than one among ten.
//!
//! A server's load changes only with a report, with a placement, and when a placement is given up. The fleet updates the
//! order after each of these; `expired` tells which servers have placements to give up.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

/// What servers are sorted by: the least load goes first, and of equal loads the server that was chosen longest ago.
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
    /// The current entries of each server: its rank if it has room, and its next expiry.
    entries: BTreeMap<Id, (Option<Rank>, Option<Instant>)>,
    ranked: BTreeSet<(Rank, Id)>,
    expiries: BTreeSet<(Instant, Id)>,
}

impl<Id: Clone + Ord> Order<Id> {
    pub(super) fn new() -> Self {
        Self { entries: BTreeMap::new(), ranked: BTreeSet::new(), expiries: BTreeSet::new() }
    }

    /// Sets the rank of a server, `None` if it has no room, and when its next placement is given up.
    pub(super) fn put(&mut self, id: &Id, rank: Option<Rank>, expiry: Option<Instant>) {
        let before = self.entries.get(id).copied().unwrap_or_default();
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
        self.entries.insert(id.clone(), (rank, expiry));
    }

    /// Forgets a server.
    pub(super) fn remove(&mut self, id: &Id) {
        self.put(id, None, None);
        self.entries.remove(id);
    }

    /// The servers with room, the least loaded first.
    pub(super) fn servers(&self) -> impl Iterator<Item = &Id> {
        self.ranked.iter().map(|(_, id)| id)
    }

    /// The servers that have placements to give up.
    pub(super) fn expired(&self, now: Instant) -> impl Iterator<Item = &Id> {
        self.expiries.iter().take_while(move |(at, _)| *at <= now).map(|(_, id)| id)
    }
}
