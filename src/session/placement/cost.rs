//! What one client costs a server, learned from its reports.
//!
//! Each server has a least squares fit of `load = base + cost * clients` ([`CostFit`]), in which old reports fade and
//! which starts from a guess. Other programs only ever add load, so a report far above the fit counts little. Clients
//! differ, so a server that has seen few knows little, and after one client nothing. The fleet ([`FleetCost`]) knows
//! how much its servers differ, and shrinks each server's estimate towards the mean of all: similar servers are treated
//! alike, and a new one starts from what the others have learned.

use std::time::Duration;

/// Time in which the weight of a report falls to 1/e; only time with clients counts.
const MEMORY: Duration = Duration::from_mins(10);
/// Longest time that one report stands for, so that the report after a gap does not weigh too much.
const MAX_STEP: Duration = Duration::from_secs(10);
/// Weight of the assumption that an idle server's load is 0, in seconds of reports.
const BASE_TRUST: f64 = 2.0;
/// Largest weight of the load of an idle server, in seconds.
const IDLE_MEMORY: f64 = 60.0;
/// Variance of a load around the fit, in percent squared, for one second of reports: 2 % for five seconds, because each
/// load is a mean of five seconds.
const NOISE: f64 = 2.0 * 2.0 * 5.0;
/// A load that is this far above the fit, in percent, counts as load of other programs.
const FOREIGN: f64 = 15.0;
/// Weight of a report that contains load of other programs: a fiftieth. It is not zero, because clients may have become
/// more expensive.
const FOREIGN_TRUST: f64 = 0.02;
/// Variance of one client's cost, relative to the square of the mean cost.
const VARIETY: f64 = 0.16;
/// From this load on, in percent, a report is only a lower bound, because the machine has no more to give.
pub(super) const FULL: f64 = 99.0;
/// The lowest plausible cost, in percent: idle clients may become active.
const LOWEST: f64 = 0.25;
/// The highest plausible cost, in percent.
const HIGHEST: f64 = 50.0;

/// Clamps a cost to the plausible range, in percent; NaN becomes the highest.
pub(super) fn believable(cost: f64) -> f64 {
    if cost.is_nan() {
        HIGHEST
    } else {
        cost.clamp(LOWEST, HIGHEST)
    }
}

/// Whether a load is so far above the expected one, both in percent, that other programs must be running.
fn is_foreign(load: f64, expected: f64) -> bool {
    load > expected + FOREIGN
}

/// One server's estimate of its cost: the logarithm, and its precision (one over the variance of that logarithm). The
/// default contains no information.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Estimate {
    log: f64,
    precision: f64,
}

/// The fit for one server: the weighted sums of its reports.
#[derive(Debug, Clone, Default)]
pub(super) struct CostFit {
    guess: f64,
    weight: f64,
    clients: f64,
    clients_squared: f64,
    load: f64,
    clients_by_load: f64,
    /// The load without clients, in percent, and its weight in seconds.
    idle_load: f64,
    idle_weight: f64,
    /// Number of clients that the fit is based on.
    seen: f64,
    /// Number of arrivals since the last report that counted in full.
    arrived: f64,
}

impl CostFit {
    /// Nothing learned yet: a client costs `guess` percent.
    pub(super) fn new(guess: f64) -> Self {
        let guess = believable(guess);
        Self {
            guess,
            idle_weight: BASE_TRUST,
            ..Self::default()
        }
    }

    /// This server's own estimate. `believed` is the cost that was assumed until now, in percent. The variance is taken
    /// relative to it, so that a high estimate does not count as more precise.
    pub(super) fn estimate(&self, believed: f64) -> Estimate {
        let (_, slope, variance) = self.fit();
        let relative = variance / (believed * believed);
        // One start is not evidence: any load that began at the same time would be attributed to it.
        let seen = if self.seen > 1.0 { self.seen } else { 0.0 };
        // The precision is 1 / (relative + VARIETY / seen), and 0 without evidence.
        Estimate {
            log: slope.ln(),
            precision: seen / (seen * relative + VARIETY),
        }
    }

    /// Counts clients that have arrived.
    pub(super) fn count_arrivals(&mut self, clients: f64) {
        self.arrived += clients;
    }

    /// Learns that the server had this `load`, in percent, with this number of `clients`. `elapsed` is the time since
    /// the report before, and `trust` (0 to 1) how well the number of clients is known.
    pub(super) fn learn(&mut self, clients: f64, load: f64, elapsed: Duration, trust: f64) {
        let seconds = elapsed.min(MAX_STEP).as_secs_f64();
        let load = load.min(100.0);
        // A full machine can show that its clients cost more than assumed, but not that they cost less.
        let (base, slope, _) = self.fit();
        let expected = base + slope * clients;
        let says_nothing = load >= FULL && expected >= load;
        if says_nothing || seconds == 0.0 {
            return;
        }
        if clients < 0.5 {
            let seconds = if is_foreign(load, self.idle_load) {
                seconds * FOREIGN_TRUST
            } else {
                seconds
            };
            let weight = (self.idle_weight + seconds).min(IDLE_MEMORY);
            self.idle_load += (load - self.idle_load) * seconds / weight;
            self.idle_weight = weight;
        } else {
            let fade = (-seconds / MEMORY.as_secs_f64()).exp();
            let weight = if is_foreign(load, expected) {
                trust * seconds * FOREIGN_TRUST
            } else {
                self.seen += std::mem::take(&mut self.arrived);
                trust * seconds
            };
            self.weight = self.weight * fade + weight;
            self.clients = self.clients * fade + weight * clients;
            self.clients_squared = self.clients_squared * fade + weight * clients * clients;
            self.load = self.load * fade + weight * load;
            self.clients_by_load = self.clients_by_load * fade + weight * clients * load;
            self.seen *= fade;
        }
    }

    /// The base and the cost of a client, both in percent of load, and the variance of the cost.
    fn fit(&self) -> (f64, f64, f64) {
        let trust = NOISE / (self.guess * self.guess);
        let weight = self.weight + self.idle_weight;
        let load = self.load + self.idle_weight * self.idle_load;
        let squares = self.clients_squared + trust;
        let products = self.clients_by_load + trust * self.guess;
        // Positive, because weight * clients_squared >= clients * clients holds before the positive terms are added to
        // the first two.
        let determinant = weight * squares - self.clients * self.clients;
        let base = (load * squares - self.clients * products) / determinant;
        // A base can't be negative: if the best fit has a negative one, use the best fit without a base.
        let (base, slope, variance) = if base < 0.0 {
            (0.0, products / squares, NOISE / squares)
        } else {
            (
                base,
                (weight * products - self.clients * load) / determinant,
                NOISE * weight / determinant,
            )
        };
        (base, believable(slope), variance)
    }
}

/// Sums over the estimates of a fleet's servers. From these follow the mean, and how much servers differ from it beyond
/// the uncertainty of their estimates.
#[derive(Debug, Clone, Default)]
pub(super) struct FleetCost {
    servers: f64,
    precision: f64,
    precision_squared: f64,
    log: f64,
    log_squared: f64,
}

impl FleetCost {
    /// Replaces a server's estimate.
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

    /// Cost of a client on a server with this estimate, in percent: always positive and finite. `guess` is the cost
    /// that is assumed without any data.
    pub(super) fn cost(&self, own: Estimate, guess: f64) -> f64 {
        // The guess counts as one more server, with an uncertainty of a factor of e.
        let mean = (self.log + believable(guess).ln()) / (self.precision + 1.0);
        let own_share = own.precision * self.spread();
        believable(((own.log * own_share + mean) / (own_share + 1.0)).exp())
    }

    /// The variance of the logarithm of the cost between servers.
    fn spread(&self) -> f64 {
        if self.servers < 2.0 || self.precision <= 0.0 {
            return 0.0;
        }
        // The estimator of DerSimonian and Laird (1986), which compares clinical trials as this compares servers.
        let scatter = self.log_squared - self.log * self.log / self.precision;
        let scale = self.precision - self.precision_squared / self.precision;
        if scale <= 0.0 {
            return 0.0;
        }
        ((scatter - (self.servers - 1.0)) / scale).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use crate::session::placement::{LoadBalancer, PlacementPolicy};
    use crate::shared::domain::{Instances, Load, ServerReport};
    use std::time::{Duration, Instant};

    /// A fleet of this many servers, and its start.
    fn fleet(client_cost: f64, servers: u32) -> (LoadBalancer<u32>, Instant) {
        let mut fleet = LoadBalancer::new(PlacementPolicy {
            client_cost,
            ..PlacementPolicy::default()
        });
        (0..servers).for_each(|id| fleet.add(id));
        (fleet, Instant::now())
    }

    fn report(load: f64, present: u32, arrivals: u32) -> ServerReport {
        let instances = Instances {
            running: present,
            slots: 1000,
            arrivals: arrivals.into(),
            ..Instances::default()
        };
        ServerReport {
            instances: Some(instances),
            ..ServerReport::load_only(Load::try_from(load).unwrap())
        }
    }

    fn assert_near(value: Option<f64>, expected: f64, tolerance: f64) {
        assert!(
            value.is_some_and(|value| (value - expected).abs() <= tolerance),
            "{value:?} is not {expected}"
        );
    }

    /// Reports once a second for ten minutes, while the number of clients moves between 0 and 10.
    fn teach(fleet: &mut LoadBalancer<u32>, id: u32, start: Instant, cost: f64) {
        for second in 0..600_u32 {
            // Each client stays long enough for the mean load to show it.
            let step = second / 20;
            let present = if (step / 10).is_multiple_of(2) {
                step % 10
            } else {
                10 - step % 10
            };
            let noise = if second.is_multiple_of(2) { 1.0 } else { -1.0 };
            let load = (5.0 + cost * f64::from(present) + noise).min(100.0);
            fleet.report(
                &id,
                start + Duration::from_secs(second.into()),
                &report(load, present, step + 1),
                true,
            );
        }
    }

    #[test]
    fn the_cost_of_a_client_is_learned_for_each_server() {
        let costs = [0.5, 1.0, 2.0, 4.0, 8.0];
        let (mut fleet, start) = fleet(2.0, 5);
        for (id, cost) in (0..).zip(costs) {
            teach(&mut fleet, id, start, cost);
        }
        for (id, cost) in (0..).zip(costs) {
            assert_near(fleet.client_cost(&id), cost, 0.2 * cost);
        }
    }

    #[test]
    fn a_new_server_is_expected_to_be_like_the_others() {
        let (mut fleet, start) = fleet(2.0, 4);
        (0..4).for_each(|id| teach(&mut fleet, id, start, 6.0));
        fleet.add(9);
        assert_eq!(fleet.client_cost(&9), Some(2.0));
        fleet.report(&9, start, &report(0.0, 0, 0), true);
        assert_near(fleet.client_cost(&9), 6.0, 0.6);
        // Similar servers count as equal, apart from the shift of the mean between their last reports.
        assert_near(fleet.client_cost(&1), 6.0, 0.6);
    }

    #[test]
    fn an_absurd_policy_does_no_harm() {
        for client_cost in [0.0, -3.0, f64::NAN, f64::INFINITY] {
            let (mut fleet, start) = fleet(client_cost, 3);
            (0..3).for_each(|id| teach(&mut fleet, id, start, 2.0));
            assert_near(fleet.client_cost(&0), 2.0, 0.4);
        }
    }

    #[test]
    fn a_full_machine_does_not_teach_that_clients_are_cheap() {
        let (mut fleet, start) = fleet(2.0, 1);
        for second in 0..300_u32 {
            let now = start + Duration::from_secs(second.into());
            fleet.report(&0, now, &report(100.0, 20 + second, 20 + second), true);
            assert!(!fleet.available(now, |_, _| true));
        }
        assert!(fleet.client_cost(&0).is_some_and(|cost| cost >= 2.0));
    }

    /// One server, with reports of (seconds, load, clients).
    fn taught(reports: &[(u32, f64, u32)]) -> (LoadBalancer<u32>, Instant) {
        let (mut fleet, start) = fleet(2.0, 1);
        let mut second = 0;
        let mut arrivals = 0;
        let mut before = 0;
        for (seconds, load, present) in reports {
            arrivals += present.saturating_sub(before);
            before = *present;
            for _ in 0..*seconds {
                fleet.report(
                    &0,
                    start + Duration::from_secs(second),
                    &report(*load, *present, arrivals),
                    true,
                );
                second += 1;
            }
        }
        (fleet, start + Duration::from_secs(second))
    }

    #[test]
    fn one_noisy_start_teaches_nothing() {
        // One client arrives and leaves while other programs add this much load.
        for noise in [5.0, 8.0, 13.0, 40.0] {
            let (mut fleet, now) = taught(&[(30, 3.0, 0), (60, 5.0 + noise, 1), (10, 3.0, 0)]);
            assert_near(fleet.client_cost(&0), 2.0, 0.1);
            let placed = (0..40).filter(|_| fleet.pick(now, true, |_| true).is_some()).count();
            assert_eq!(placed, 40, "at {:?} % each", fleet.client_cost(&0));
        }
    }

    #[test]
    fn load_of_other_programs_is_not_that_of_clients() {
        // Clients cost 2 %. Other programs take 40 % for two thirds of the time, also without clients.
        let mut reports = vec![(60, 3.0, 0), (30, 43.0, 0)];
        for present in [2, 5, 8, 5, 8, 3] {
            let load = 3.0 + 2.0 * f64::from(present);
            reports.extend([(40, load + 40.0, present), (20, load, present)]);
            let (fleet, _) = taught(&reports);
            assert_near(fleet.client_cost(&0), 2.0, 0.6);
        }
    }
}
