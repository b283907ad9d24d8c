//! What one client costs one server, learned from its reports.
//!
//! A least squares fit of `load = base + cost * clients` in which old reports fade and which starts from a guess, so that
//! it answers sensibly from the first report on: the guess holds until there is something to learn from, a server that is
//! watched while its clients come and go gives the cost, and one whose number of clients never changes still tells that
//! cost and base explain its load together.

use std::time::Duration;

/// How long a report is remembered: its weight falls to 1/e in that time.
const MEMORY: Duration = Duration::from_mins(10);
/// The most time that one report stands for, so that a gap between reports does not make the next one weigh too much.
const LONGEST_STEP: Duration = Duration::from_secs(10);
/// An idle server's load is expected to be 0; that expectation weighs as much as so many seconds of reports.
const BASE_TRUST: f64 = 2.0;
/// The guessed cost weighs as much as so many seconds of watching a server with one client, if the guess is 1 %; a
/// greater guess is less certain, and its weight falls with its square.
const COST_TRUST: f64 = 45.0;
/// From this load on a report only says 'at least so much', because the machine has no more to give.
pub(super) const FULL: f64 = 99.0;
/// The lowest cost that is believed, in percent: clients that do nothing yet may start to.
const LOWEST: f64 = 0.1;
/// The highest cost that is believed, in percent.
const HIGHEST: f64 = 50.0;

/// The fit for one server: the weighted sums of the samples seen, and what follows from them.
#[derive(Debug, Clone)]
pub(super) struct Cost {
    guess: f64,
    weight: f64,
    clients: f64,
    clients_squared: f64,
    load: f64,
    clients_by_load: f64,
    base: f64,
    percent: f64,
}

impl Cost {
    /// Nothing learned yet: a client costs `guess` percent.
    pub(super) fn new(guess: f64) -> Self {
        // `clamp` would let NaN through; `max` does not.
        let guess = guess.max(LOWEST).min(HIGHEST);
        Self {
            guess,
            weight: 0.0,
            clients: 0.0,
            clients_squared: 0.0,
            load: 0.0,
            clients_by_load: 0.0,
            base: 0.0,
            percent: guess,
        }
    }

    /// What one more client is expected to add to the load, in percent: always positive and finite.
    pub(super) fn percent(&self) -> f64 {
        self.percent
    }

    /// Learns that the server had this `load` while it held so many `clients`. `elapsed` is the time since the report
    /// before, and `trust` (0 to 1) tells how well the number of clients is known.
    pub(super) fn learn(&mut self, clients: f64, load: f64, elapsed: Duration, trust: f64) {
        let fade = (-elapsed.as_secs_f64() / MEMORY.as_secs_f64()).exp();
        let load = load.min(100.0);
        // A full machine can teach that its clients cost more than was thought, but not that they cost less.
        let says_nothing = load >= FULL && self.base + self.percent * clients >= load;
        let weight = if says_nothing {
            0.0
        } else {
            trust * elapsed.min(LONGEST_STEP).as_secs_f64()
        };
        self.weight = self.weight * fade + weight;
        self.clients = self.clients * fade + weight * clients;
        self.clients_squared = self.clients_squared * fade + weight * clients * clients;
        self.load = self.load * fade + weight * load;
        self.clients_by_load = self.clients_by_load * fade + weight * clients * load;
        self.fit();
    }

    fn fit(&mut self) {
        let trust = COST_TRUST / (self.guess * self.guess);
        let weight = self.weight + BASE_TRUST;
        let squares = self.clients_squared + trust;
        let products = self.clients_by_load + trust * self.guess;
        // Positive, because weight * squares >= clients * clients holds already without the two trusts.
        let determinant = weight * squares - self.clients * self.clients;
        let base = (self.load * squares - self.clients * products) / determinant;
        let cost = if base < 0.0 {
            // No machine is less than idle: the best fit that has no base.
            products / squares
        } else {
            (weight * products - self.clients * self.load) / determinant
        };
        self.base = base.max(0.0);
        self.percent = cost.max(LOWEST).min(HIGHEST);
    }
}
