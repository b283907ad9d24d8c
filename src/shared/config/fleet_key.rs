//! The rule for the key `fleetKey` of both servers.

use super::loading::require;
use super::secret::Secret;

/// Fewest letters of `fleetKey`.
const MIN_FLEET_KEY: usize = 16;

/// Checks the key `fleetKey`: whoever guesses it takes places that are not his.
///
/// # Errors
/// When it is too short.
pub fn check_fleet_key(key: Option<&Secret>) -> Result<(), String> {
    let is_long = key.is_none_or(|key| key.reveal().chars().count() >= MIN_FLEET_KEY);
    require(is_long, "fleetKey", || {
        format!("it is shorter than {MIN_FLEET_KEY} letters; `openssl rand -hex 32` prints a good one")
    })
}
