//! How many simulations run in real time here: the places of a server shrink while its simulations are slower than they
//! can be. Part of the slot pool. The rule is described in `docs/placement.md`.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// What is known of how many simulations run in real time.
#[derive(Debug, Default)]
pub(super) struct RealTimePlaces {
    /// The best factor that a simulation of each world has reached here, at most 1.
    best: HashMap<String, f64>,
    limit: Option<Limit>,
}

/// The number of places, once simulations were slow.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Limit {
    places: usize,
    /// `places` does not fall below this before simulations are well again.
    least: usize,
    /// When simulations were slow last.
    slow: Instant,
    /// When it has changed last.
    changed: Instant,
}

/// How fast one simulation runs.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pace {
    pub(super) world: String,
    /// Simulated seconds per second.
    pub(super) factor: f64,
}

/// Simulations are well again once they were not slow for this long.
const WELL: Duration = Duration::from_secs(10);
/// Time without slow simulations after which places are added.
const RAISE: Duration = Duration::from_mins(5);
/// Number of worlds of which the best factor is kept.
const WORLDS: usize = 1000;

impl RealTimePlaces {
    /// The number of places, if it is limited.
    pub(super) fn places(&self) -> Option<usize> {
        self.limit.map(|limit| limit.places)
    }

    /// Takes in how fast simulations run at `now`. `used` places of `all` have clients; `target` is the factor that is to
    /// be kept.
    pub(super) fn take_in(&mut self, paces: &[Pace], (used, all): (usize, usize), target: f64, now: Instant) {
        let threshold = f64::midpoint(1.0, target);
        let relative: Vec<f64> = paces.iter().map(|pace| self.relative(pace)).collect();
        let slow = relative.iter().filter(|factor| **factor < threshold).count();
        if slow >= 2 && 2 * slow >= relative.len() {
            self.shrink(used, relative.iter().map(|factor| 1.0 - factor).sum(), now);
        } else {
            self.recover(used, all, now);
        }
    }

    /// The speed of a simulation as a share of the best of its world.
    fn relative(&mut self, pace: &Pace) -> f64 {
        let factor = pace.factor.min(1.0);
        if self.best.len() >= WORLDS && !self.best.contains_key(&pace.world) {
            self.best.clear();
        }
        let best = self.best.entry(pace.world.clone()).or_default();
        *best = best.max(factor);
        if *best > 0.0 { factor / *best } else { 1.0 }
    }

    /// Simulations are slow. The sum of their speeds is what the machine can do; `lost` is what is missing.
    fn shrink(&mut self, used: usize, lost: f64, now: Instant) {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "less than the number of simulations"
        )]
        let fitting = used.saturating_sub(lost.round() as usize);
        let begins = self.limit.is_none_or(|limit| now.duration_since(limit.slow) >= WELL);
        let before = self.limit.filter(|_| !begins);
        let least = before.map_or(used.div_ceil(2), |limit| limit.least);
        let known = self.limit.map_or(used, |limit| limit.places);
        let places = fitting.min(known).max(least);
        if begins {
            log::warn!(
                "simulations run slower than they can: of {used} that have a place {fitting} would run in real time. Until \
                 they are well again no more clients are offered places (realTime.target)"
            );
        }
        self.limit = Some(Limit {
            places,
            least,
            slow: now,
            changed: now,
        });
    }

    /// Simulations are not slow, or too few are known to tell.
    fn recover(&mut self, used: usize, all: usize, now: Instant) {
        let Some(limit) = &mut self.limit else { return };
        let mut places = limit.places;
        if now.duration_since(limit.slow) >= WELL {
            // What runs well has been shown to fit.
            places = places.max(used);
        }
        if now.duration_since(limit.changed) >= RAISE {
            places += (places / 10).max(1);
        }
        if places != limit.places {
            limit.places = places;
            limit.changed = now;
        }
        if places >= all {
            self.limit = None;
            log::info!("simulations run well: all {all} places are offered again");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: f64 = 0.9;

    fn paces(world: &str, factors: &[f64]) -> Vec<Pace> {
        let pace = |factor: &f64| Pace {
            world: world.to_owned(),
            factor: *factor,
        };
        factors.iter().map(pace).collect()
    }

    /// A server with 40 places. It looks once a second.
    struct Server {
        places: RealTimePlaces,
        now: Instant,
    }

    impl Server {
        fn new() -> Self {
            Self {
                places: RealTimePlaces::default(),
                now: Instant::now(),
            }
        }

        /// These simulations run for some seconds. Returns the places then.
        fn run(&mut self, paces: &[Pace], used: usize, seconds: u32) -> Option<usize> {
            for _ in 0..seconds {
                self.now += Duration::from_secs(1);
                self.places.take_in(paces, (used, 40), TARGET, self.now);
            }
            self.places.places()
        }
    }

    #[test]
    fn places_follow_what_the_machine_can_do() {
        let mut server = Server::new();
        assert_eq!(server.run(&paces("a", &[1.0; 20]), 20, 60), None);
        // A machine for 20: all share what it can do.
        assert_eq!(
            server.run(&paces("a", &[20.0 / 21.0; 21]), 21, 60),
            None,
            "above the threshold"
        );
        assert_eq!(server.run(&paces("a", &[20.0 / 25.0; 25]), 25, 1), Some(20));
        // Of those that still start, too.
        assert_eq!(server.run(&paces("a", &[20.0 / 30.0; 30]), 30, 5), Some(20));
        assert_eq!(server.run(&paces("a", &[1.0; 19]), 19, 60), Some(20), "it is known now");
        // What those that are not slow lack counts, too.
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 30]), 30, 1);
        let mixed = [[0.8; 15], [0.96; 15]].concat();
        assert_eq!(server.run(&paces("a", &mixed), 30, 1), Some(26));
    }

    #[test]
    fn slow_is_what_is_below_halfway_from_the_target_to_one() {
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 40]), 40, 1);
        let halfway = f64::midpoint(TARGET, 1.0);
        assert_eq!(server.run(&paces("a", &[halfway; 40]), 40, 1), None);
        assert_eq!(server.run(&paces("a", &[halfway - 0.01; 40]), 40, 1), Some(38));
    }

    #[test]
    fn places_come_back_slowly_and_at_once_for_those_that_run_well() {
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 30]), 30, 1);
        let slow = paces("a", &[0.5; 30]);
        assert_eq!(server.run(&slow, 30, 1), Some(15));
        let less_slow = paces("a", &[0.9; 30]);
        assert_eq!(server.run(&less_slow, 30, 60), Some(15), "more would not be well");
        // Another program was the cause.
        let well = paces("a", &[1.0; 30]);
        assert_eq!(server.run(&well, 30, 9), Some(15), "not yet");
        assert_eq!(server.run(&well, 30, 1), Some(30));
        assert_eq!(server.run(&well, 10, 299), Some(30));
        assert_eq!(server.run(&well, 10, 1), Some(33));
        assert_eq!(server.run(&[], 0, 600), Some(39));
        assert_eq!(server.run(&[], 0, 300), None);
        // On a full server that is well all places are known to fit.
        server.run(&paces("a", &[0.5; 40]), 40, 1);
        assert_eq!(server.run(&paces("a", &[1.0; 40]), 40, 10), None);
    }

    #[test]
    fn places_are_added_to_few_and_for_those_that_come_later() {
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 5]), 5, 1);
        assert_eq!(server.run(&paces("a", &[0.1; 5]), 5, 1), Some(3), "half of five");
        let well = paces("a", &[1.0; 3]);
        assert_eq!(server.run(&well, 3, 300), Some(4));
        assert_eq!(server.run(&well, 6, 1), Some(6));
        assert_eq!(server.run(&well, 7, 1), Some(7));
    }

    #[test]
    fn those_that_are_slow_again_soon_after_they_were_well_are_counted_anew() {
        let slow = |server: &mut Server, used: usize| server.run(&paces("a", &vec![0.2; used]), used, 1);
        for (seconds, places) in [(8, 15), (9, 5), (10, 5), (11, 5)] {
            let mut server = Server::new();
            server.run(&paces("a", &[1.0; 30]), 30, 1);
            assert_eq!(slow(&mut server, 30), Some(15));
            server.run(&paces("a", &[1.0; 20]), 20, seconds);
            assert_eq!(slow(&mut server, 10), Some(places), "after {seconds} s");
        }
        // Of more clients half of the places remain.
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 30]), 30, 1);
        slow(&mut server, 30);
        server.run(&paces("a", &[1.0; 30]), 30, 9);
        assert_eq!(slow(&mut server, 38), Some(19));
    }

    #[test]
    fn a_world_that_is_slow_by_itself_is_compared_with_its_own_best() {
        let mut server = Server::new();
        assert_eq!(server.run(&paces("heavy", &[0.5]), 1, 60), None);
        assert_eq!(server.run(&paces("heavy", &[0.5; 10]), 10, 60), None);
        assert_eq!(server.run(&paces("heavy", &[0.4; 10]), 10, 1), Some(8));
        // Beside faster ones, too.
        let mut server = Server::new();
        let both = [paces("a", &[1.0; 5]), paces("heavy", &[0.5; 6])].concat();
        assert_eq!(server.run(&both, 11, 60), None);
        // One that stands still says nothing, neither of the machine nor of others.
        let still = paces("still", &[0.0; 4]);
        assert_eq!(server.run(&still, 4, 60), None);
        let both = [paces("a", &[0.5; 4]), still].concat();
        assert_eq!(server.run(&both, 8, 1), Some(6));
    }

    #[test]
    fn a_world_that_has_run_faster_than_real_time_is_not_slow_in_it() {
        let mut server = Server::new();
        assert_eq!(server.run(&paces("fast", &[20.0; 10]), 10, 60), None);
        assert_eq!(server.run(&paces("fast", &[1.0; 10]), 10, 60), None);
    }

    #[test]
    fn few_slow_ones_say_nothing_about_the_machine() {
        let mut server = Server::new();
        let mut all = paces("a", &[1.0; 10]);
        all.extend(paces("b", &[1.0; 10]));
        server.run(&all, 20, 1);
        all.iter_mut().take(9).for_each(|pace| pace.factor = 0.1);
        assert_eq!(server.run(&all, 20, 60), None);
        all.iter_mut().take(10).for_each(|pace| pace.factor = 0.1);
        assert_eq!(server.run(&all, 20, 1), Some(11));
        let mut few = Server::new();
        few.run(&paces("a", &[1.0]), 1, 1);
        assert_eq!(few.run(&paces("a", &[0.1]), 1, 60), None);
        assert_eq!(few.run(&paces("a", &[0.1; 2]), 2, 1), Some(1));
    }

    #[test]
    fn a_world_that_becomes_slow_by_itself_takes_at_most_half_of_the_places_in_use() {
        let mut server = Server::new();
        server.run(&paces("a", &[1.0; 10]), 10, 1);
        for used in (1..=10).rev() {
            server.run(&paces("a", &vec![0.2; used]), used, 60);
        }
        assert_eq!(server.places.places(), Some(5));
    }

    #[test]
    fn forged_times_change_only_their_own_figure() {
        let mut server = Server::new();
        let mut all = paces("a", &[1.0; 10]);
        all.push(Pace {
            world: "forged".to_owned(),
            factor: 1000.0,
        });
        for second in 0..60 {
            all[10].factor = if second % 2 == 0 { 1000.0 } else { 0.0 };
            assert_eq!(server.run(&all, 11, 1), None);
        }
        assert_eq!(
            server.run(&paces("a", &[0.8; 10]), 10, 1),
            Some(8),
            "of others it is known as before"
        );
    }

    #[test]
    fn many_worlds_take_little_memory() {
        let mut server = Server::new();
        for number in 0..3 * WORLDS {
            server.run(&paces(&number.to_string(), &[1.0]), 1, 1);
            assert!(server.places.best.len() <= WORLDS);
        }
        // The table is full, and what it has is used.
        assert_eq!(server.places.best.len(), WORLDS);
        let last = (3 * WORLDS - 1).to_string();
        assert_eq!(server.run(&paces(&last, &[0.5; 10]), 10, 1), Some(5));
    }
}
