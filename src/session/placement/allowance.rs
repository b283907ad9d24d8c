//! How many placements of one client address count: so that an address whose clients never come can't close a fleet.
//!
//! Each placement uses up room until its client comes or is given up, so that somebody who only asks, again and again,
//! could keep everybody out. An address starts with an allowance that is enough for a class behind one address. A client
//! that does not come takes a part of it, one that comes adds as much: so it falls where more stay away than come, and a
//! class of which a few never come keeps most of it. What exceeds the allowance is placed like everything else, but takes
//! no room. Who came is told by a server's arrivals, or by its load where it tells nothing else.

use std::collections::{HashMap, VecDeque};
use std::net::IpAddr;
use std::time::{Duration, Instant};

/// The allowance of an address that nothing is known of: more than a large class.
const CLASS: usize = 1024;
/// Which part of its allowance one client is worth: were it a half, ten who change their minds would leave a class of
/// hundreds with next to nothing.
const PART: usize = 16;
/// Nothing that was held against an address counts any more when it has not asked for so long: a school has another class.
const FORGIVEN: Duration = Duration::from_mins(30);
/// From so many addresses on, those are forgotten that have not asked lately, and new ones are not noted in between.
const MANY: usize = 10_000;

/// What is known of client addresses.
#[derive(Debug, Default)]
pub(super) struct Allowances {
    addresses: HashMap<IpAddr, Allowance>,
    /// When it was looked last for those that can be forgotten.
    cleared: Option<Instant>,
}

/// One address.
#[derive(Debug)]
struct Allowance {
    most: usize,
    /// When its placements that count were made, oldest first; none is older than the policy's patience.
    recent: VecDeque<Instant>,
    /// When it asked last.
    asked: Instant,
}

impl Allowances {
    /// Whether another placement of this address counts; if so, it is one of its allowance for so long.
    pub(super) fn take(&mut self, address: IpAddr, now: Instant, patience: Duration) -> bool {
        if self.addresses.len() >= MANY && !self.addresses.contains_key(&address) {
            // So many strangers at once are no class: nothing is known of them, and each counts.
            if self.cleared.is_some_and(|at| now.saturating_duration_since(at) < patience) {
                return true;
            }
            self.cleared = Some(now);
            self.addresses.retain(|_, known| now.saturating_duration_since(known.asked) < patience);
        }
        let new = || Allowance { most: CLASS, recent: VecDeque::new(), asked: now };
        let known = self.addresses.entry(address).or_insert_with(new);
        if now.saturating_duration_since(known.asked) >= FORGIVEN {
            known.most = CLASS;
        }
        known.asked = now;
        let old = known.recent.partition_point(|made| now.saturating_duration_since(*made) >= patience);
        known.recent.drain(..old);
        let counts = known.recent.len() < known.most;
        if counts {
            known.recent.push_back(now);
        }
        counts
    }

    /// A client of this address has come to where it was sent.
    pub(super) fn came(&mut self, address: IpAddr) {
        if let Some(known) = self.addresses.get_mut(&address) {
            known.most = (known.most + known.most.div_ceil(PART)).min(CLASS);
        }
    }

    /// A client of this address has not come.
    pub(super) fn missed(&mut self, address: IpAddr) {
        if let Some(known) = self.addresses.get_mut(&address) {
            known.most = (known.most - known.most.div_ceil(PART)).max(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_secs(15);

    fn address(number: u32) -> IpAddr {
        std::net::Ipv4Addr::from_bits(number).into()
    }

    fn taken(allowances: &mut Allowances, now: Instant) -> usize {
        (0..2 * CLASS).filter(|_| allowances.take(address(1), now, PATIENCE)).count()
    }

    #[test]
    fn a_class_counts_and_those_who_never_come_count_less_and_less() {
        let start = Instant::now();
        let mut allowances = Allowances::default();
        assert_eq!(taken(&mut allowances, start), CLASS);
        assert_eq!(taken(&mut allowances, start + PATIENCE / 2), 0, "all of it is in use");
        (0..10).for_each(|_| allowances.missed(address(1)));
        let left = taken(&mut allowances, start + PATIENCE);
        assert!((CLASS / 2..CLASS).contains(&left), "{left} after ten of a class have not come");
        (0..99).for_each(|_| allowances.missed(address(1)));
        assert_eq!(taken(&mut allowances, start + PATIENCE * 2), 1, "one is left to prove itself by");
        (0..150).for_each(|_| allowances.came(address(1)));
        assert_eq!(taken(&mut allowances, start + PATIENCE * 3), CLASS);
        (0..200).for_each(|_| allowances.missed(address(1)));
        assert_eq!(taken(&mut allowances, start + PATIENCE * 4), 1);
        assert_eq!(taken(&mut allowances, start + PATIENCE * 4 + FORGIVEN), CLASS);
    }

    #[test]
    fn what_is_known_of_addresses_is_bounded() {
        let start = Instant::now();
        let mut allowances = Allowances::default();
        for number in 0..3 * u32::try_from(MANY).unwrap() {
            assert!(allowances.take(address(number), start + PATIENCE / 50_000 * number, PATIENCE));
        }
        assert!(allowances.addresses.len() <= MANY + 1, "{}", allowances.addresses.len());
    }
}
