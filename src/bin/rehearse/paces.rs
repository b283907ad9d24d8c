//! How fast simulations run at this moment.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};

use crate::visit::Visit;

/// The paces of the last seconds of clients whose simulations run.
#[derive(Default)]
pub(crate) struct Paces(RefCell<BTreeMap<u32, Seat>>);

/// A client whose simulation runs.
struct Seat {
    server: String,
    last: VecDeque<f64>,
}

/// Number of seconds of which the pace of a client is the mean.
const SECONDS: usize = 5;

impl Paces {
    /// Adds the last pace of a client.
    pub(crate) fn add(&self, visit: &Visit) {
        let (Some(server), Some(pace)) = (&visit.server, visit.pace.last()) else {
            return;
        };
        // The first second, in which it starts, does not count.
        if visit.pace.len() < 2 {
            return;
        }
        let mut seats = self.0.borrow_mut();
        let seat = seats.entry(visit.client).or_insert_with(|| Seat {
            server: server.clone(),
            last: VecDeque::new(),
        });
        seat.last.push_back(pace.factor);
        if seat.last.len() > SECONDS {
            seat.last.pop_front();
        }
    }

    /// Forgets a client that has left.
    pub(crate) fn remove(&self, client: u32) {
        self.0.borrow_mut().remove(&client);
    }

    /// The server of a client that has run for long enough.
    pub(crate) fn settled(&self, client: u32) -> Option<String> {
        let seats = self.0.borrow();
        let seat = seats.get(&client).filter(|seat| seat.last.len() == SECONDS)?;
        Some(seat.server.clone())
    }

    /// The pace of each client of a server.
    pub(crate) fn of(&self, server: &str) -> Vec<f64> {
        let seats = self.0.borrow();
        let here = seats.values().filter(|seat| seat.server == server);
        #[expect(clippy::cast_precision_loss, reason = "a few seconds")]
        here.map(|seat| seat.last.iter().sum::<f64>() / seat.last.len() as f64)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::behaviour::Behaviour;
    use crate::visit::{Outcome, Pace, Steps};

    #[test]
    fn a_client_has_settled_after_five_seconds_without_the_first() {
        let paces = Paces::default();
        let mut visit = Visit {
            client: 1,
            behaviour: Behaviour::Ordinary,
            asked: 0.0,
            server: Some("gpu-1:2000".to_owned()),
            place: None,
            turn: None,
            outcome: Outcome::Unseen,
            steps: Steps::default(),
            pace: Vec::new(),
            ended: 0.0,
        };
        for (second, factor) in [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5].into_iter().enumerate() {
            assert_eq!(paces.settled(1).is_some(), second > 5, "{second}");
            visit.pace.push(Pace { at: 0.0, factor });
            paces.add(&visit);
        }
        assert_eq!((paces.of("gpu-1:2000"), paces.of("gpu-2:2000")), (vec![0.9], vec![]));
    }
}
