//! How many placements of one client address take room on the simulation servers.
//!
//! A placement takes room until its client comes or is given up. Somebody who only asks, again and again, could so keep
//! everybody out. So the placements of an address are limited by rate: those beyond the limit are made all the same, but
//! take room only once their clients have come. Where the address is not known, or too many are, clients are believed.

use std::num::NonZeroU32;

use crate::shared::http::AddressQuota;

/// How many placements of an address take room at once: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// How many more of them take room in each minute after that: 12.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(11);

/// The quota of placements that take room.
pub fn placements() -> AddressQuota {
    AddressQuota::new(BURST, PER_MINUTE)
}
