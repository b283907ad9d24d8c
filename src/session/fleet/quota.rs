//! How many placements of one client address take room on the simulation servers.
//!
//! A placement takes room until its client comes or is given up. Somebody who only asks, again and again, could so keep
//! everybody out. So the placements of an address are limited by rate: those beyond the limit are made all the same, but
//! take room only once their clients have come.

use std::net::IpAddr;
use std::num::NonZeroU32;

use governor::{DefaultKeyedRateLimiter, Quota, RateLimiter};

/// How many placements of an address take room at once: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// How many more of them take room in each minute after that: 12.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(11);
/// How many addresses are remembered.
const MOST_ADDRESSES: usize = 10_000;

/// The quota of every address.
#[derive(Debug)]
pub struct PlacementQuota(DefaultKeyedRateLimiter<IpAddr>);

impl PlacementQuota {
    /// A quota that nobody has used yet.
    #[must_use]
    pub fn new() -> Self {
        Self(RateLimiter::keyed(Quota::per_minute(PER_MINUTE).allow_burst(BURST)))
    }

    /// Whether another placement for this address takes room. It does where the address is not known, and where too many
    /// addresses are remembered: clients that are not known to only ask are believed.
    pub fn take(&self, address: Option<IpAddr>) -> bool {
        address.is_none_or(|address| self.0.len() >= MOST_ADDRESSES || self.0.check_key(&address).is_ok())
    }

    /// Forgets the addresses whose whole quota is available again. To be called now and then.
    pub fn clean_up(&self) {
        if self.0.len() >= MOST_ADDRESSES / 2 {
            self.0.retain_recent();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(number: u32) -> IpAddr {
        std::net::Ipv4Addr::from_bits(number).into()
    }

    #[test]
    fn each_address_has_a_quota_of_its_own() {
        let quota = PlacementQuota::new();
        let taken = |address| (0..1000).filter(|_| quota.take(address)).count();
        for number in [1, 2] {
            assert!((200..205).contains(&taken(Some(address(number)))));
        }
        assert_eq!(taken(None), 1000, "who asks through a proxy that tells no addresses is not limited");
    }

    #[test]
    fn the_addresses_that_are_remembered_are_bounded() {
        let quota = PlacementQuota::new();
        for number in 0..3 * u32::try_from(MOST_ADDRESSES).unwrap() {
            assert!(quota.take(Some(address(number))));
        }
        assert!(quota.0.len() <= MOST_ADDRESSES);
        quota.clean_up();
        assert!(quota.0.len() <= MOST_ADDRESSES);
    }
}
