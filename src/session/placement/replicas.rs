//! How many clients other session servers send to the same fleet.
//!
//! Session servers share nothing, so none sees what the others have placed since the last reports. But each sees how many
//! clients come and how many of them it has sent, so it knows for how many each of its placements stands: with three like
//! it beside it, for four. That counts from one report of a server to the next, so that a mistake is short.
//!
//! Dispatchers that take the arrivals of all to be theirs times their number are known from Goren, Vargaftik and Moses,
//! "Stochastic Coordination in Heterogeneous Load Balancing Systems" (PODC 2021); here the number is learned instead of set.

/// After so many clients, what was seen before them weighs 1/e.
const MEMORY: f64 = 200.0;
/// What is believed from the beginning, that nobody else sends clients, weighs as much as so many of them.
const DOUBT: f64 = 20.0;
/// The most that is believed: more session servers are not recommended, and somebody who starts simulations without asking
/// for a server is not to close the fleet.
const MOST: f64 = 4.0;

/// The clients that came to the servers of a fleet, and how many of them were sent from here.
#[derive(Debug, Clone, Default)]
pub(super) struct Replicas {
    came: f64,
    sent: f64,
}

impl Replicas {
    /// So many clients came to some server; so many that were sent there from here have come or have been given up.
    pub(super) fn count(&mut self, came: f64, sent: f64) {
        let fade = (-came.max(sent) / MEMORY).exp();
        self.came = self.came * fade + came.min(MEMORY);
        self.sent = self.sent * fade + sent.min(MEMORY);
    }

    /// How many clients come for each that is sent from here: 1 where nobody else sends any.
    pub(super) fn clients_per_placement(&self) -> f64 {
        ((self.came + DOUBT) / (self.sent + DOUBT)).clamp(1.0, MOST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clients that come one by one, of which each `n`th was sent from here.
    fn after(peers: &mut Replicas, clients: u32, n: u32) -> f64 {
        for client in 1..=clients {
            peers.count(1.0, f64::from(u8::from(client % n == 0)));
        }
        peers.clients_per_placement()
    }

    #[test]
    fn the_number_of_session_servers_is_learned_and_forgotten() {
        let mut peers = Replicas::default();
        assert_eq!(after(&mut peers, 500, 1).to_bits(), 1.0_f64.to_bits());
        let four = after(&mut peers, 1000, 4);
        assert!((3.0..=MOST).contains(&four), "{four}");
        let one = after(&mut peers, 1000, 1);
        assert!(one < 1.1, "{one}");
    }

    #[test]
    fn clients_that_never_come_and_absurd_counts_do_no_harm() {
        let mut peers = Replicas::default();
        peers.count(0.0, 1e9);
        assert_eq!(peers.clients_per_placement().to_bits(), 1.0_f64.to_bits());
        peers.count(1e19, 0.0);
        assert!(peers.clients_per_placement() <= MOST);
        let recovered = after(&mut peers, 1000, 1);
        assert!(recovered < 1.1, "{recovered}");
    }
}
