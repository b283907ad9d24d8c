//! How many simulations the clients of one address may ask for: each costs a checkout and a start of Webots.

use std::num::NonZeroU32;

use crate::shared::http::AddressQuota;

/// How many at once, at least: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// How many in each minute after that: 60.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(59);

/// The quota of simulations that are asked for, on a server with so many places: a class that takes all of them, and then
/// reloads its pages, stays within it.
#[must_use]
pub fn starts(places: u16) -> AddressQuota {
    AddressQuota::new(NonZeroU32::new(2 * u32::from(places)).map_or(BURST, |twice| BURST.max(twice)), PER_MINUTE)
}
