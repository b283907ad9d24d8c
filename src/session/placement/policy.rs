//! What can be set about placement.

use std::time::Duration;

/// What the owner of a fleet can set.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacementPolicy {
    /// A server takes clients while its effective load is under this, in percent. Default: 95.
    pub threshold: f64,
    /// What a client costs a server that reports only its load, in percent; the others start from this and learn. Default: 2.
    pub client_cost: f64,
    /// How long a placement counts whose client does not come. Default: 15 seconds.
    pub patience: Duration,
    /// How long it takes until a client that came shows fully in the reported load, which is a mean of five seconds, and a
    /// simulation needs a while to start. Default: 8 seconds.
    pub settling: Duration,
}

impl Default for PlacementPolicy {
    fn default() -> Self {
        Self { threshold: 95.0, client_cost: 2.0, patience: Duration::from_secs(15), settling: Duration::from_secs(8) }
    }
}
