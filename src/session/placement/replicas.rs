//! How many clients other session servers send to the same fleet.
//!
//! Session servers share nothing, so none sees what the others have placed since the last reports. But each sees how
//! many clients arrive and how many of them it has sent, so it knows how many clients each of its placements stands
//! for: four, with three others like it. That number is used only until the server's next report, so an error is
//! short-lived.
//!
//! Goren, Vargaftik and Moses, "Stochastic Coordination in Heterogeneous Load Balancing Systems" (PODC 2021), describe
//! dispatchers that multiply their own arrivals by their number; here the number is learned instead of set.

/// Number of clients after which earlier ones weigh 1/e.
const MEMORY: f64 = 200.0;
/// Weight of the initial assumption that no other session server sends clients, in clients.
const DOUBT: f64 = 20.0;
/// Upper limit of the estimate: more session servers are not recommended, and a client that starts simulations without
/// requesting a server must not close the fleet.
const MAX_ESTIMATE: f64 = 4.0;

/// The clients that arrived at the servers of a fleet, and how many of them were sent from here.
#[derive(Debug, Clone, Default)]
pub(super) struct Replicas {
    came: f64,
    sent: f64,
}

impl Replicas {
    /// Counts clients that arrived at some server, and clients sent there from here that have arrived or been given up.
    pub(super) fn count(&mut self, came: f64, sent: f64) {
        let fade = (-came.max(sent) / MEMORY).exp();
        self.came = self.came * fade + came.min(MEMORY);
        self.sent = self.sent * fade + sent.min(MEMORY);
    }

    /// Number of clients that arrive for each that is sent from here: 1 if no other session server sends any.
    pub(super) fn clients_per_placement(&self) -> f64 {
        ((self.came + DOUBT) / (self.sent + DOUBT)).clamp(1.0, MAX_ESTIMATE)
    }
}
