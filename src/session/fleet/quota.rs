//! Rate limit of the placements of one client address that reserve room on the simulation servers.
//!
//! A placement reserves room until its client arrives or is given up. A client that requests servers again and again
//! could thus lock out all others. Placements beyond the limit are still made, but take room only once their clients
//! have arrived. There is no limit if the address is unknown, or if the quota tracks too many addresses.

use std::num::NonZeroU32;

use crate::shared::http::AddressQuota;

/// Placements of an address that may reserve room at once: 200, a large class behind one address.
const BURST: NonZeroU32 = NonZeroU32::MIN.saturating_add(199);
/// Further placements that may reserve room, per minute: 12.
const PER_MINUTE: NonZeroU32 = NonZeroU32::MIN.saturating_add(11);

/// The quota of placements that reserve room.
pub fn placements() -> AddressQuota {
    AddressQuota::new(BURST, PER_MINUTE)
}
