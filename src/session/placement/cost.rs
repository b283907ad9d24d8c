//! What one client costs a server, learned from the reports.
//!
//! Each server has a least squares fit of `load = base + cost * clients` ([`Cost`]), in which old reports fade and which
//! starts from a guess. Clients differ, so a server that has seen few knows little; the fleet ([`Common`]) tells how much
//! the servers differ at all, and by that each server's own estimate is drawn towards what all have in common: servers that
//! look alike are taken as alike, and a new one starts from what the others have learned.
//!
//! A server that reports only its load does not tell how many clients it has. There the fit is of the steps between
//! reports: how the load changed while so many clients that were sent there began to show. Who left is not known; that it
//! is the more the higher the load was is learned with it: `change = cost * clients - leaving * load * seconds`.

use std::time::{Duration, Instant};

/// How long a report is remembered: its weight falls to 1/e in that time, of which only the time with clients counts.
const MEMORY: Duration = Duration::from_mins(10);
/// The most time that one report stands for, so that a gap between reports does not make the next one weigh too much.
const LONGEST_STEP: Duration = Duration::from_secs(10);
/// An idle server's load is expected to be 0; that weighs as much as so many seconds of reports.
const BASE_TRUST: f64 = 2.0;
/// An idle server's load is remembered for so many seconds.
const IDLE_MEMORY: f64 = 60.0;
/// How far a load lies from what the fit says, as a variance in percent squared, for one second of reports: 2 % for five
/// seconds, since so many make one mean.
const NOISE: f64 = 2.0 * 2.0 * 5.0;
/// How far clients differ: the variance of one client's cost, relative to the square of the mean cost.
const VARIETY: f64 = 0.16;
/// The least time that is a step for the fit of steps: the mean load of five seconds is another one then.
const STEP: Duration = Duration::from_secs(5);
/// How far a step lies from what the fit says while nobody leaves, as a variance in percent squared.
const STEP_NOISE: f64 = 0.5;
/// What share of a load is expected to leave in a second, where sessions are short.
const LEAVING: f64 = 0.01;
/// A load that should have risen by so much, in percent, and has by hardly anything tells that nobody came.
const CLEAR_RISE: f64 = 20.0;
/// What a machine without clients is expected to report, in percent: that much of its load never leaves.
const USUAL_IDLE: f64 = 3.0;
/// Steps are not believed if they say that a client costs less than this share of the guess: their errors are great, and
/// a server that is thought too able is sent too many.
const STEP_LOWEST: f64 = 0.4;
/// From this load on a report only says 'at least so much', because the machine has no more to give.
pub(super) const FULL: f64 = 99.0;
/// The lowest cost that is believed, in percent: clients that do nothing yet may start to.
const LOWEST: f64 = 0.25;
/// The highest cost that is believed, in percent.
const HIGHEST: f64 = 50.0;

/// A believable cost, whatever the number.
pub(super) fn believable(cost: f64) -> f64 {
    if cost.is_nan() { HIGHEST } else { cost.clamp(LOWEST, HIGHEST) }
}

/// Judges by how much a load has risen whether so many clients came, who are believed to cost so much each. Loads move by
/// themselves too, so that many must be missing before it is said.
fn who_came(risen: f64, clients: f64, believed: f64) -> Told {
    let expected = clients * believed;
    if clients <= 0.5 && risen > CLEAR_RISE {
        Told::Late
    } else if clients > 0.5 && risen > expected * 0.5 {
        Told::Came
    } else if expected > CLEAR_RISE && risen < expected * 0.1 {
        Told::Missed
    } else {
        Told::Nothing
    }
}

/// What one server says about its cost: the logarithm, and how sure it is (one over the variance of that logarithm).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Estimate {
    log: f64,
    precision: f64,
}

/// What a step between two loads tells of those who were sent there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Told {
    /// The step is not over.
    NotYet,
    /// Nothing for sure.
    Nothing,
    /// Most of them have come.
    Came,
    /// Hardly anybody has, until now.
    Missed,
    /// Some, although nobody was to be expected: those who had been missing.
    Late,
}

/// The fit for one server, of `load = base * unit + cost * clients`: the weighted sums of the samples, and what follows
/// from them. Of reports the unit is 1, and the base what the machine does besides. Of steps the load is how much it
/// changed, the unit the load that was there while it did, times the seconds, and the base what share of that came in a
/// second: less than none, for it left.
#[derive(Debug, Clone)]
pub(super) struct Cost {
    guess: f64,
    units_squared: f64,
    units_by_clients: f64,
    clients_squared: f64,
    units_by_load: f64,
    clients_by_load: f64,
    /// The load without clients, and how many seconds it was seen.
    idle_load: f64,
    idle_weight: f64,
    /// How many clients the fit rests on.
    seen: f64,
    /// Whether the samples are steps between reports.
    of_steps: bool,
    /// Where the last step ended: when, how many clients had shown until then, and the load.
    step: Option<(Instant, f64, f64)>,
    base: f64,
    slope: f64,
    variance: f64,
}

impl Cost {
    /// Nothing learned yet: a client costs `guess` percent.
    pub(super) fn new(guess: f64) -> Self {
        let guess = believable(guess);
        Self {
            guess,
            units_squared: 0.0,
            units_by_clients: 0.0,
            clients_squared: 0.0,
            units_by_load: 0.0,
            clients_by_load: 0.0,
            idle_load: 0.0,
            idle_weight: BASE_TRUST,
            seen: 0.0,
            of_steps: false,
            step: None,
            base: 0.0,
            slope: guess,
            variance: guess * guess,
        }
    }

    /// This server's own estimate. `believed` is what its clients have been taken to cost until now, in percent: an
    /// estimate is not surer for being high.
    pub(super) fn estimate(&self, believed: f64) -> Estimate {
        let relative = self.variance / (believed * believed);
        Estimate {
            log: self.slope.ln(),
            // This is 1 / (relative + VARIETY / seen), and 0 where none was seen.
            precision: self.seen / (self.seen * relative + VARIETY),
        }
    }

    /// So many clients were seen for the first time.
    pub(super) fn meet(&mut self, clients: f64) {
        self.seen += clients;
    }

    /// Learns that the server had this `load` while it held so many `clients`. `elapsed` is the time since the report
    /// before, and `trust` (0 to 1) tells how well the number of clients is known.
    pub(super) fn learn(&mut self, clients: f64, load: f64, elapsed: Duration, trust: f64) {
        let seconds = elapsed.min(LONGEST_STEP).as_secs_f64();
        let load = load.min(100.0);
        // A full machine can teach that its clients cost more than was thought, but not that they cost less.
        let says_nothing = load >= FULL && self.base + self.slope * clients >= load;
        if says_nothing || seconds == 0.0 {
            return;
        }
        if clients < 0.5 {
            let weight = (self.idle_weight + seconds).min(IDLE_MEMORY);
            self.idle_load += (load - self.idle_load) * seconds / weight;
            self.idle_weight = weight;
        } else {
            self.add(1.0, clients, load, trust * seconds, seconds);
        }
        self.fit();
    }

    /// Learns from a server that tells its load only: of all clients that were ever sent there, `shown` are expected to be
    /// in this load. `believed` is what one has been taken to cost until now, in percent.
    pub(super) fn learn_step(&mut self, now: Instant, shown: f64, load: f64, believed: f64) -> Told {
        self.of_steps = true;
        let mut told = Told::Nothing;
        if let Some((begin, shown_before, load_before)) = self.step {
            let elapsed = now.saturating_duration_since(begin);
            if elapsed < STEP {
                return Told::NotYet;
            }
            // What a full machine reports is no measure of anything.
            if load_before < FULL && load < FULL {
                let clients = (shown - shown_before).max(0.0);
                let seconds = elapsed.min(LONGEST_STEP).as_secs_f64();
                let was_there = seconds * (f64::midpoint(load_before, load) - USUAL_IDLE).max(0.0);
                told = who_came(load - load_before - self.base * was_there, clients, believed);
                // Clients leave one by one, each with its cost, and those who come differ.
                let noise = STEP_NOISE + believed * (LEAVING * was_there + VARIETY * believed * clients);
                // Who has not come tells nothing of those who do, and how many have come late is not known.
                if !matches!(told, Told::Missed | Told::Late) {
                    self.add(was_there, clients, load - load_before, NOISE / noise, seconds);
                    self.meet(clients);
                    self.fit();
                }
            }
        }
        self.step = Some((now, shown, load));
        told
    }

    fn add(&mut self, unit: f64, clients: f64, load: f64, weight: f64, seconds: f64) {
        let fade = (-seconds / MEMORY.as_secs_f64()).exp();
        self.units_squared = self.units_squared * fade + weight * unit * unit;
        self.units_by_clients = self.units_by_clients * fade + weight * unit * clients;
        self.clients_squared = self.clients_squared * fade + weight * clients * clients;
        self.units_by_load = self.units_by_load * fade + weight * unit * load;
        self.clients_by_load = self.clients_by_load * fade + weight * clients * load;
        self.seen *= fade;
    }

    fn fit(&mut self) {
        let trust = NOISE / (self.guess * self.guess);
        // What is expected of the base.
        let (expected, sure) =
            if self.of_steps { (0.0, NOISE / (2.0 * LEAVING).powi(2)) } else { (self.idle_load, self.idle_weight) };
        let (weight, load) = (self.units_squared + sure, self.units_by_load + sure * expected);
        let squares = self.clients_squared + trust;
        let products = self.clients_by_load + trust * self.guess;
        let mixed = self.units_by_clients;
        // Positive, because weight * squares >= mixed * mixed holds already without what is added to the two.
        let determinant = weight * squares - mixed * mixed;
        let base = (load * squares - mixed * products) / determinant;
        // No machine is less than idle, and no load comes from itself: if the best fit says so, then the best one that has
        // no base.
        let is_absurd = if self.of_steps { base > 0.0 } else { base < 0.0 };
        let (base, cost, variance) = if is_absurd {
            (0.0, products / squares, NOISE / squares)
        } else {
            let cost = (weight * products - mixed * load) / determinant;
            (base, cost, NOISE * weight / determinant)
        };
        self.base = base;
        self.slope = believable(cost);
        if self.of_steps {
            self.slope = self.slope.max(self.guess * STEP_LOWEST);
        }
        self.variance = variance;
    }
}

/// What the servers of a fleet have in common: sums over their estimates, from which follow the mean and how far servers
/// really differ from it, beyond the doubt in their estimates.
#[derive(Debug, Clone)]
pub(super) struct Common {
    servers: f64,
    precision: f64,
    precision_squared: f64,
    log: f64,
    log_squared: f64,
}

impl Common {
    /// A fleet without servers.
    pub(super) fn new() -> Self {
        Self { servers: 0.0, precision: 0.0, precision_squared: 0.0, log: 0.0, log_squared: 0.0 }
    }

    /// Replaces what a server said before by what it says now.
    pub(super) fn replace(&mut self, old: Estimate, new: Estimate) {
        for (sign, estimate) in [(-1.0, old), (1.0, new)] {
            let Estimate { log, precision } = estimate;
            self.servers += if precision > 0.0 { sign } else { 0.0 };
            self.precision += sign * precision;
            self.precision_squared += sign * precision * precision;
            self.log += sign * precision * log;
            self.log_squared += sign * precision * log * log;
        }
    }

    /// What a client costs a server that estimates so, in percent: always positive and finite. `guess` is what a client
    /// is expected to cost when nothing is known.
    pub(super) fn cost(&self, own: Estimate, guess: f64) -> f64 {
        // The guess counts as one more server, which is in doubt by a factor of e.
        let mean = (self.log + believable(guess).ln()) / (self.precision + 1.0);
        let spread = self.spread();
        let own_share = own.precision * spread;
        believable(((own.log * own_share + mean) / (own_share + 1.0)).exp())
    }

    /// The variance of the logarithm of the cost between servers.
    fn spread(&self) -> f64 {
        if self.servers < 2.0 || self.precision <= 0.0 {
            return 0.0;
        }
        // The estimator of DerSimonian and Laird (1986), who compare clinical trials as we compare servers.
        let scatter = self.log_squared - self.log * self.log / self.precision;
        let scale = self.precision - self.precision_squared / self.precision;
        if scale <= 0.0 {
            return 0.0;
        }
        ((scatter - (self.servers - 1.0)) / scale).max(0.0)
    }
}
