//! Rate limit of simulations that the clients of one address request: each costs a checkout and a start of Webots.

use std::num::NonZeroU32;

use crate::shared::http::AddressQuota;

/// Least number at once: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// Number per minute after that: 60.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(59);

/// The quota of requested simulations on a server with this many slots: a class that takes all of them, and then
/// reloads its pages, stays within it.
pub fn starts(places: u16) -> AddressQuota {
    AddressQuota::new(NonZeroU32::new(2 * u32::from(places)).map_or(BURST, |twice| BURST.max(twice)), PER_MINUTE)
}
