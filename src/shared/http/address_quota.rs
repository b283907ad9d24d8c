//! Limits for one client address, so that it does not use up everything.

use std::net::IpAddr;
use std::num::NonZeroU32;

use governor::{DefaultKeyedRateLimiter, Quota, RateLimiter};

/// Largest number of addresses that are tracked.
const MAX_ADDRESSES: usize = 10_000;

/// Default limit for one address, of `all` slots, connections and the like: three quarters. A class often sits behind
/// one address, and so may a client that would take everything.
pub fn share(all: usize) -> usize {
    all - all / 4
}

/// Rate limit per client address.
#[derive(Debug)]
pub struct AddressQuota(DefaultKeyedRateLimiter<IpAddr>);

impl AddressQuota {
    /// An unused quota: `burst` times at once, and `per_minute` times in each minute after that.
    pub fn new(burst: NonZeroU32, per_minute: NonZeroU32) -> Self {
        Self(RateLimiter::keyed(Quota::per_minute(per_minute).allow_burst(burst)))
    }

    /// Takes one from the quota of an address. Returns whether it had one left; always true if the address is unknown,
    /// or if too many addresses are tracked.
    pub fn take(&self, address: Option<IpAddr>) -> bool {
        let Some(address) = address else { return true };
        if self.0.len() >= MAX_ADDRESSES {
            // Drops the addresses whose whole quota is available again.
            self.0.retain_recent();
        }
        self.0.len() >= MAX_ADDRESSES || self.0.check_key(&address).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_addresses_that_are_remembered_are_bounded() {
        let quota = AddressQuota::new(NonZeroU32::new(200).unwrap(), NonZeroU32::new(12).unwrap());
        for number in 0..12_000 {
            assert!(quota.take(Some(std::net::Ipv4Addr::from_bits(number).into())));
        }
        assert!(quota.0.len() <= MAX_ADDRESSES);
    }
}
