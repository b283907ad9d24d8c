//! What one simulation server was asked for, and what it has answered.

use std::time::Duration;

use super::waiting_line::{LISTED, Place};
use crate::shared::domain::{Hello, Offers, PassedOver, ReservationId, ServerRun, Wish, Wishes};

/// The longest time that a reservation may hold.
const MAX_PASS: Duration = Duration::from_hours(1);
/// Most reservations that are given back at once. A server makes no more than it was told of clients; others that it
/// claims to have made end by themselves.
const MAX_BACK: usize = 2 * LISTED;
/// Most addresses and users that a server passes over: those of the clients that it was told of.
const MAX_PASSED: usize = 2 * LISTED;
/// Most clients at its own door that count for the positions of others.
const MAX_QUEUE: usize = 10_000;

/// The connection to a simulation server that reserves slots.
#[derive(Debug)]
pub(super) struct Link {
    /// Its run.
    pub(super) server: ServerRun,
    /// How long its reservations hold.
    pub(super) pass: Duration,
    /// The clients that it was told of last.
    listed: Vec<Place>,
    /// The number of the last wishes, and of the last that it has answered.
    sent: u64,
    answered: u64,
    /// Reservations to give back with the next wishes.
    back: Vec<ReservationId>,
    /// When the clients at its own door have come, in milliseconds since 1970, in order.
    pub(super) queue: Vec<u64>,
    /// Whom it passes over, of those that it was told of.
    pub(super) passed: Vec<PassedOver>,
}

impl Link {
    /// A connection that was just made.
    pub(super) fn new(hello: &Hello) -> Self {
        Self {
            server: hello.server,
            pass: Duration::try_from_secs_f64(hello.pass).map_or(MAX_PASS, |pass| pass.min(MAX_PASS)),
            listed: Vec::new(),
            sent: 0,
            answered: 0,
            back: Vec::new(),
            queue: Vec::new(),
            passed: Vec::new(),
        }
    }

    /// The clients that it has not answered for yet.
    pub(super) fn unanswered(&self) -> &[Place] {
        if self.owes_answer() { &self.listed } else { &[] }
    }

    /// Whether it has not answered yet, so that it is told nothing else.
    pub(super) fn owes_answer(&self) -> bool {
        self.answered < self.sent
    }

    /// Gives a reservation back with the next wishes.
    pub(super) fn give_back(&mut self, reservation: ReservationId) {
        if self.back.len() < MAX_BACK {
            self.back.push(reservation);
        }
    }

    /// Records what it has sent at `now`, in milliseconds since 1970.
    pub(super) fn answered(&mut self, offers: &Offers, now: u64) {
        self.answered = offers.number.min(self.sent);
        self.passed = offers.passed.iter().take(MAX_PASSED).cloned().collect();
        let queue = offers.queue.iter().take(MAX_QUEUE);
        self.queue = queue.map(|waited| now.saturating_sub(*waited)).collect();
        self.queue.sort_unstable();
    }

    /// The next wishes, if it must hear of these clients: the first of the line that it accepts, of `all`. While it has
    /// not answered, it is told nothing else. `waits` is whether a client still waits. Some of the clients that it knows
    /// may be gone: it hears that when it offers them a slot.
    pub(super) fn wishes(
        &mut self,
        first: Vec<Place>,
        all: u32,
        waits: impl Fn(&Place) -> bool,
        wish: impl Fn(&Place) -> Option<Wish>,
    ) -> Option<Wishes> {
        if self.owes_answer() {
            return None;
        }
        let gone = self.listed.iter().filter(|place| !waits(place)).count();
        let knows_first = first.iter().take(LISTED / 2).all(|place| self.listed.contains(place));
        let is_over = first.is_empty() && !self.listed.is_empty();
        let is_current = knows_first && gone < LISTED / 2 && !is_over;
        // The clients at its own door hear from it how many are ahead.
        let must_be_exact = !self.queue.is_empty() && self.listed != first;
        if is_current && self.back.is_empty() && !must_be_exact {
            return None;
        }
        self.sent += 1;
        let wishes = Wishes {
            number: self.sent,
            first: first.iter().filter_map(wish).collect(),
            all,
            back: std::mem::take(&mut self.back),
        };
        self.listed = first;
        Some(wishes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(numbers: impl IntoIterator<Item = u64>) -> Vec<Place> {
        numbers
            .into_iter()
            .map(|number| Place { since: number, number })
            .collect()
    }

    fn link() -> Link {
        Link::new(&Hello {
            challenge: 0,
            server: ServerRun(1),
            pass: 10.0,
            keeps_ready: true,
            roster: false,
        })
    }

    /// Asks for slots for these clients, of whom those from `begin` on still wait; returns the tickets that were sent.
    fn ask(link: &mut Link, begin: u64, end: u64) -> Option<Vec<u64>> {
        let first = places(begin..end.min(begin + 32));
        let all = u32::try_from(end - begin).unwrap();
        let wish = |place: &Place| {
            Some(Wish {
                ticket: place.number,
                waited: 0,
                address: None,
                user: None,
                world: None,
            })
        };
        let wishes = link.wishes(first, all, |place| place.number >= begin, wish)?;
        Some(wishes.first.iter().map(|wish| wish.ticket).collect())
    }

    fn answer(link: &mut Link) {
        let offers = Offers {
            number: link.sent,
            ..Offers::default()
        };
        link.answered(&offers, 0);
    }

    #[test]
    fn a_server_hears_what_it_needs_and_one_thing_at_a_time() {
        let mut link = link();
        assert_eq!(ask(&mut link, 0, 0), None, "nobody waits");
        assert_eq!(ask(&mut link, 0, 2), Some(vec![0, 1]));
        assert_eq!(ask(&mut link, 0, 3), None, "it has not answered");
        answer(&mut link);
        assert_eq!(ask(&mut link, 0, 3), Some(vec![0, 1, 2]), "another one has come");
        answer(&mut link);
        assert_eq!(ask(&mut link, 1, 3), None, "it knows those who wait");
        assert_eq!(ask(&mut link, 3, 3), Some(vec![]), "nobody waits any more");
    }

    #[test]
    fn of_a_long_line_it_hears_only_now_and_then() {
        let mut link = link();
        let mut sent = 0;
        for begin in 0..320 {
            sent += u32::from(ask(&mut link, begin, 10_000).is_some());
            answer(&mut link);
        }
        assert!((15..=20).contains(&sent), "{sent}");
    }

    #[test]
    fn an_answer_of_any_length_costs_little_later() {
        let mut link = link();
        let offers = Offers {
            queue: vec![5; 100_000],
            passed: (0..20_000).map(|number| PassedOver::User(number.to_string())).collect(),
            ..Offers::default()
        };
        link.answered(&offers, 7);
        assert_eq!((link.queue.len(), link.passed.len()), (10_000, 64));
    }

    #[test]
    fn a_slot_that_nobody_needs_goes_back_at_once() {
        let mut link = link();
        ask(&mut link, 0, 2);
        answer(&mut link);
        link.give_back(ReservationId(4));
        let wishes = link.wishes(Vec::new(), 0, |_| false, |_| None).unwrap();
        assert_eq!(wishes.back, [ReservationId(4)]);
    }
}
