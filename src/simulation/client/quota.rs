//! How many simulations the clients of one address may ask for: each costs a checkout and a start of Webots.

use std::num::NonZeroU32;

use crate::shared::http::AddressQuota;

/// How many at once: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// How many in each minute after that: 60.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(59);

/// The quota of simulations that are asked for.
#[must_use]
pub fn starts() -> AddressQuota {
    AddressQuota::new(BURST, PER_MINUTE)
}
