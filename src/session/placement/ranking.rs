//! The servers that have room, sorted by load, so that a choice among a thousand is as fast as one among ten.
//!
//! A server's rank changes only when it is probed or chosen, when one of its placements or its ejection expires, and
//! with the policy. The fleet updates the ranking after each of these; `expired` returns the servers with something to
//! expire.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::time::Instant;

/// Sort key of a server: ejected servers come last, then the lowest load comes first, and of equal loads the server
/// that was chosen longest ago.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rank {
    pub(super) is_ejected: bool,
    pub(super) load: f64,
    pub(super) last_pick: u64,
}

impl Eq for Rank {}

impl Ord for Rank {
    fn cmp(&self, other: &Self) -> Ordering {
        let ejected = self.is_ejected.cmp(&other.is_ejected);
        ejected.then(self.load.total_cmp(&other.load)).then(self.last_pick.cmp(&other.last_pick))
    }
}

impl PartialOrd for Rank {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// A server's entry in the ranking.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct RankEntry {
    /// `None` if the server has no room.
    pub(super) rank: Option<Rank>,
    /// When the oldest of its placements is given up, or its ejection ends, whichever is first.
    pub(super) expiry: Option<Instant>,
}

/// The ranking of a fleet, whose servers it knows by index.
#[derive(Debug, Default)]
pub(super) struct Ranking {
    ranked: BTreeSet<(Rank, usize)>,
    expiries: BTreeSet<(Instant, usize)>,
}

impl Ranking {
    /// Moves a server from one entry to another.
    pub(super) fn update(&mut self, server: usize, before: RankEntry, now: RankEntry) {
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
