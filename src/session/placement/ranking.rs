//! The servers that have room, sorted by load, so that a choice among a thousand costs no more than one among ten.
//!
//! A server's load changes only with a report, with a placement, and when a placement is given up. The fleet updates the
//! order after each of these; `expired` tells which servers have placements to give up.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::time::Instant;

/// What servers are sorted by: those that are ejected go last, then the least load goes first, and of equal loads the
/// server that was chosen longest ago.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rank {
    pub(super) is_ejected: bool,
    pub(super) load: f64,
    pub(super) turn: u64,
}

impl Eq for Rank {}

impl Ord for Rank {
    fn cmp(&self, other: &Self) -> Ordering {
        let ejected = self.is_ejected.cmp(&other.is_ejected);
        ejected.then(self.load.total_cmp(&other.load)).then(self.turn.cmp(&other.turn))
    }
}

impl PartialOrd for Rank {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// Where a server stands in the order.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct RankEntry {
    /// `None` if the server has no room.
    pub(super) rank: Option<Rank>,
    /// When the oldest of its placements is given up, or its ejection ends.
    pub(super) expiry: Option<Instant>,
}

/// The order of a fleet, whose servers it knows by their numbers.
#[derive(Debug, Default)]
pub(super) struct Ranking {
    ranked: BTreeSet<(Rank, usize)>,
    expiries: BTreeSet<(Instant, usize)>,
}

impl Ranking {
    /// Puts a server that stood somewhere else.
    pub(super) fn put(&mut self, server: usize, before: RankEntry, now: RankEntry) {
        if before.rank != now.rank {
            before.rank.map(|rank| self.ranked.remove(&(rank, server)));
            now.rank.map(|rank| self.ranked.insert((rank, server)));
        }
        if before.expiry != now.expiry {
            before.expiry.map(|at| self.expiries.remove(&(at, server)));
            now.expiry.map(|at| self.expiries.insert((at, server)));
        }
    }

    /// The servers with room, in the order of their ranks.
    pub(super) fn servers(&self) -> impl Iterator<Item = usize> {
        self.ranked.iter().map(|(_, server)| *server)
    }

    /// The servers that have placements to give up, or an ejection that ends.
    pub(super) fn expired(&self, now: Instant) -> impl Iterator<Item = usize> {
        self.expiries.iter().take_while(move |(at, _)| *at <= now).map(|(_, server)| *server)
    }
}
