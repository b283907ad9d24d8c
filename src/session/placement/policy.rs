//! The parameters of placement.

use std::time::Duration;

/// The parameters that the owner of a fleet sets.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacementPolicy {
    /// A server gets clients while its effective load is below this, in percent, and below 100 minus the cost of a
    /// client. Above 100, the load does not matter. Default: 95.
    pub threshold: f64,
    /// Cost of a client on a server that reports only its load, in percent; the others start from this and learn.
    /// Default: 2.
    pub client_cost: f64,
    /// Time after which a placement is given up if its client does not arrive. Default: 15 seconds.
    pub placement_timeout: Duration,
}

impl Default for PlacementPolicy {
    fn default() -> Self {
        Self {
            threshold: 95.0,
            client_cost: 2.0,
            placement_timeout: Duration::from_secs(15),
        }
    }
}
