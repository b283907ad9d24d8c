//! A fleet of machines, the clients that want to use it, and a clock that runs as fast as it can.

use super::dispatch::{Dispatcher, Seen};
use super::scenario::{Client, Foreign, HORIZON, Outcome, Scenario, Sizes, THRESHOLD, clients};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

/// What a client costs on a machine of medium size, in percent.
const UNIT_COST: f64 = 2.0;
/// Seconds until a new simulation reaches its full load.
const RAMP: f64 = 3.0;

/// One machine.
struct Machine {
    base: f64,
    client_cost: f64,
    demand: f64,
    demand_since: f64,
    overload: f64,
    present: u32,
    arrivals: u64,
    /// The clients that are starting: since when, and their cost.
    starting: VecDeque<(f64, f64)>,
    samples: VecDeque<f64>,
    /// The load of other programs.
    foreign: f64,
    /// If each start fails here, the seconds after which it does.
    fails_after: Option<f64>,
    /// Clients whose start has not failed yet.
    failing: u32,
    failed_starts: u32,
}

impl Machine {
    fn change(&mut self, now: f64, by: f64) {
        if self.demand > 100.0 {
            self.overload += now - self.demand_since;
        }
        self.demand_since = now;
        self.demand += by;
    }

    fn sample(&mut self, now: f64, noise: f64) {
        while self.starting.front().is_some_and(|(since, _)| now - since >= RAMP) {
            self.starting.pop_front();
        }
        let not_yet: f64 = self
            .starting
            .iter()
            .map(|(since, cost)| cost * (1.0 - (now - since) / RAMP))
            .sum();
        if self.samples.len() == 5 {
            self.samples.pop_front();
        }
        self.samples
            .push_back((self.demand - not_yet + noise).clamp(0.0, 100.0));
    }

    /// Starts or ends other programs at random; called each second.
    fn run_others(&mut self, now: f64, random: &mut StdRng) {
        let switches = random.random_range(0.0..1.0) < if self.foreign > 0.0 { 1.0 / 30.0 } else { 1.0 / 60.0 };
        if switches {
            let load = if self.foreign > 0.0 {
                0.0
            } else {
                random.random_range(20.0..60.0)
            };
            self.change(now, load - self.foreign);
            self.foreign = load;
        }
    }

    fn seen(&self) -> Seen {
        Seen {
            load: self.samples.iter().sum::<f64>() / self.samples.len() as f64,
            present: self.present,
            starting: self.failing,
            arrivals: self.arrivals,
            failed_starts: self.failed_starts,
        }
    }
}

/// What happens to a client after it has been placed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Step {
    Comes,
    Leaves,
    Fails,
}

/// Microseconds, so that events have an order.
fn micros(seconds: f64) -> u64 {
    (seconds * 1e6) as u64
}

/// Runs a scenario against a policy.
pub(crate) fn run(scenario: &Scenario, seed: u64, dispatcher: &mut impl Dispatcher) -> Outcome {
    let mut random = StdRng::seed_from_u64(seed);
    let mut machines = machines(scenario, &mut random);
    let room = |machine: &Machine| (THRESHOLD - machine.base) / machine.client_cost;
    let capacity = machines
        .iter()
        .filter(|machine| machine.fails_after.is_none())
        .map(room)
        .sum();
    let clients = clients(scenario, capacity, &mut random);
    // The servers are probed in turn, each once per refresh.
    let mut asked = 0_usize;
    let mut order: Vec<usize> = (0..machines.len()).collect();
    for i in (1..order.len()).rev() {
        order.swap(i, random.random_range(0..=i));
    }
    for (id, machine) in machines.iter_mut().enumerate() {
        machine.sample(0.0, 0.0);
        dispatcher.report(id, 0.0, machine.seen());
    }
    let mut events: BinaryHeap<Reverse<(u64, Step, usize, usize)>> = BinaryHeap::new();
    let mut next_client = 0;
    let mut next_sample = 1.0;
    let mut refused = 0_u32;
    let mut failed = 0_u32;
    let mut highest = 0.0_f64;
    loop {
        let next_report = scenario.refresh * (asked + 1) as f64 / machines.len() as f64;
        let request = clients.get(next_client).map_or(f64::INFINITY, |client| client.at);
        let event = events
            .peek()
            .map_or(f64::INFINITY, |Reverse((at, ..))| *at as f64 / 1e6);
        let now = next_report.min(request).min(event).min(next_sample);
        if now > HORIZON {
            break;
        }
        if now == event {
            let Some(Reverse((_, step, client, server))) = events.pop() else {
                break;
            };
            let (Client { weight, session, .. }, machine): (&Client, &mut Machine) =
                (&clients[client], &mut machines[server]);
            let cost = weight * machine.client_cost;
            if step == Step::Comes
                && let Some(fails_after) = machine.fails_after
            {
                machine.present += 1;
                machine.failing += 1;
                machine.arrivals += 1;
                events.push(Reverse((micros(now + fails_after), Step::Fails, client, server)));
            } else if step == Step::Fails {
                machine.present -= 1;
                machine.failing -= 1;
                machine.failed_starts += 1;
                failed += 1;
            } else if step == Step::Comes {
                machine.change(now, cost);
                machine.present += 1;
                machine.arrivals += 1;
                machine.starting.push_back((now, cost));
                highest = highest.max(machine.demand);
                events.push(Reverse((micros(now + session), Step::Leaves, client, server)));
            } else {
                machine.change(now, -cost);
                machine.present -= 1;
            }
        } else if now == next_sample {
            for machine in &mut machines {
                if scenario.foreign == Foreign::ComesAndGoes {
                    machine.run_others(now, &mut random);
                }
                machine.sample(now, random.random_range(-1.5..1.5));
            }
            next_sample += 1.0;
        } else if now == next_report {
            let server = order[asked % order.len()];
            dispatcher.report(server, now, machines[server].seen());
            asked += 1;
        } else {
            let client = &clients[next_client];
            match dispatcher.place(now) {
                Some(server) if client.comes => {
                    events.push(Reverse((micros(now + client.travel), Step::Comes, next_client, server)));
                }
                Some(_) => {}
                None => refused += 1,
            }
            next_client += 1;
        }
    }
    for machine in &mut machines {
        machine.change(HORIZON, 0.0);
    }
    let overload: f64 = machines.iter().map(|machine| machine.overload).sum();
    Outcome {
        highest,
        overload: 100.0 * overload / (HORIZON * machines.len() as f64),
        refused: 100.0 * f64::from(refused) / clients.len() as f64,
        failed: 100.0 * f64::from(failed) / clients.len() as f64,
    }
}

fn machines(scenario: &Scenario, random: &mut StdRng) -> Vec<Machine> {
    (0..scenario.servers)
        .map(|i| {
            let base = random.random_range(1.0..5.0);
            Machine {
                base,
                client_cost: match scenario.sizes {
                    Sizes::Equal => UNIT_COST,
                    Sizes::Mixed => UNIT_COST * [0.5, 0.75, 1.0, 2.0, 4.0][i % 5],
                },
                demand: base,
                demand_since: 0.0,
                overload: 0.0,
                present: 0,
                arrivals: 0,
                starting: VecDeque::new(),
                samples: VecDeque::new(),
                foreign: 0.0,
                fails_after: scenario.fails_after.filter(|_| i == 0),
                failing: 0,
                failed_starts: 0,
            }
        })
        .collect()
}
