//! A fleet of machines, the clients that want to use it, and a clock that runs as fast as it can.

use crate::dispatch::{Dispatcher, Sight};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

/// Seconds that a run lasts.
const HORIZON: f64 = 300.0;
/// When a class comes.
const BURST_AT: f64 = 150.0;
/// The mean length of a session, in seconds: short, so that what a report says is soon wrong.
const MEAN_SESSION: f64 = 100.0;
/// What a client costs on the middle one of machines, in percent.
const UNIT_COST: f64 = 2.0;
/// The share of clients that are given a server and never go there.
const NO_SHOW: f64 = 0.02;
/// Seconds until a new simulation needs all that it is going to need.
const RAMP: f64 = 3.0;
/// The load at which a server's own rule stops taking clients, in percent.
pub(crate) const THRESHOLD: f64 = 95.0;

/// How the clients come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arrivals {
    /// One by one, for 65 % of what the fleet can hold.
    Steady,
    /// A class in one moment, on top of some others: 200 for up to 5 servers, else 1,000.
    Moment,
    /// The same class in a minute.
    Minute,
    /// One by one, for 130 % of what the fleet can hold.
    TooMany,
    /// On top of 50 %, in one moment one and a half times as many as the whole fleet can hold.
    Crowd,
}

impl Arrivals {
    pub(crate) const ALL: [Self; 5] = [
        Self::Steady,
        Self::Moment,
        Self::Minute,
        Self::TooMany,
        Self::Crowd,
    ];
}

/// How the machines differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sizes {
    /// Not at all.
    Equal,
    /// By a factor of up to 8: a client costs 1, 1.5, 2, 4 or 8 %.
    Mixed,
}

/// How the lengths of the sessions are spread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sessions {
    /// Exponential.
    Exponential,
    /// Pareto with alpha 1.5, bounded at a hundred times the shortest.
    Heavy,
}

/// What is simulated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scenario {
    pub(crate) arrivals: Arrivals,
    pub(crate) refresh: f64,
    pub(crate) servers: usize,
    pub(crate) sizes: Sizes,
    pub(crate) sessions: Sessions,
}

/// What came of a run.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Outcome {
    /// The highest load that the clients on any server asked for, in percent; over 100 they did not get it.
    pub(crate) highest: f64,
    /// The share of all servers' time that was spent over 100 %, in percent.
    pub(crate) overload: f64,
    /// The share of requests that were refused, in percent.
    pub(crate) refused: f64,
}

/// One client, drawn before the run, so that every policy meets the same ones.
struct Client {
    at: f64,
    /// Seconds until it connects to the server it was given.
    travel: f64,
    comes: bool,
    /// Its cost, relative to the mean one.
    weight: f64,
    session: f64,
}

/// One machine.
struct Machine {
    base: f64,
    client_cost: f64,
    demand: f64,
    demand_since: f64,
    overload: f64,
    present: u32,
    arrivals: u64,
    /// Who is still starting: since when, and the cost.
    starting: VecDeque<(f64, f64)>,
    samples: VecDeque<f64>,
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
        while self
            .starting
            .front()
            .is_some_and(|(since, _)| now - since >= RAMP)
        {
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

    fn sight(&self) -> Sight {
        Sight {
            load: self.samples.iter().sum::<f64>() / self.samples.len() as f64,
            present: self.present,
            arrivals: self.arrivals,
        }
    }
}

/// What happens to a client after it has been placed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Step {
    Comes,
    Leaves,
}

/// Microseconds, so that events have an order.
fn micros(seconds: f64) -> u64 {
    (seconds * 1e6) as u64
}

/// Runs a scenario against a policy.
pub(crate) fn run(scenario: &Scenario, seed: u64, dispatcher: &mut impl Dispatcher) -> Outcome {
    let mut random = StdRng::seed_from_u64(seed);
    let mut machines = machines(scenario, &mut random);
    let clients = clients(scenario, &machines, &mut random);
    // The servers are asked in turn, each once per refresh.
    let mut asked = 0_usize;
    let mut order: Vec<usize> = (0..machines.len()).collect();
    for i in (1..order.len()).rev() {
        order.swap(i, random.random_range(0..=i));
    }
    for (id, machine) in machines.iter_mut().enumerate() {
        machine.sample(0.0, 0.0);
        dispatcher.report(id, 0.0, machine.sight());
    }
    let mut events: BinaryHeap<Reverse<(u64, Step, usize, usize)>> = BinaryHeap::new();
    let mut next_client = 0;
    let mut next_sample = 1.0;
    let mut refused = 0_u32;
    let mut highest = 0.0_f64;
    loop {
        let next_report = scenario.refresh * (asked + 1) as f64 / machines.len() as f64;
        let request = clients
            .get(next_client)
            .map_or(f64::INFINITY, |client| client.at);
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
            let (
                Client {
                    weight, session, ..
                },
                machine,
            ): (&Client, &mut Machine) = (&clients[client], &mut machines[server]);
            let cost = weight * machine.client_cost;
            if step == Step::Comes {
                machine.change(now, cost);
                machine.present += 1;
                machine.arrivals += 1;
                machine.starting.push_back((now, cost));
                highest = highest.max(machine.demand);
                events.push(Reverse((
                    micros(now + session),
                    Step::Leaves,
                    client,
                    server,
                )));
            } else {
                machine.change(now, -cost);
                machine.present -= 1;
            }
        } else if now == next_sample {
            for machine in &mut machines {
                machine.sample(now, random.random_range(-1.5..1.5));
            }
            next_sample += 1.0;
        } else if now == next_report {
            let server = order[asked % order.len()];
            dispatcher.report(server, now, machines[server].sight());
            asked += 1;
        } else {
            let client = &clients[next_client];
            match dispatcher.place(now) {
                Some(server) if client.comes => {
                    events.push(Reverse((
                        micros(now + client.travel),
                        Step::Comes,
                        next_client,
                        server,
                    )));
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
            }
        })
        .collect()
}

fn clients(scenario: &Scenario, machines: &[Machine], random: &mut StdRng) -> Vec<Client> {
    let capacity: f64 = machines
        .iter()
        .map(|machine| (THRESHOLD - machine.base) / machine.client_cost)
        .sum();
    let class = if scenario.servers <= 5 { 200.0 } else { 1000.0 };
    // How much of the fleet the steady stream fills, how many come besides, and in how many seconds.
    let (steady, besides, within) = match scenario.arrivals {
        Arrivals::Steady => (0.65, 0.0, 0.0),
        Arrivals::Moment => ((0.85 - class / capacity).clamp(0.05, 0.65), class, 0.0),
        Arrivals::Minute => ((0.85 - class / capacity).clamp(0.05, 0.65), class, 60.0),
        Arrivals::TooMany => (1.3, 0.0, 0.0),
        Arrivals::Crowd => (0.5, 1.5 * capacity, 0.0),
    };
    let mut times: Vec<f64> = (0..besides as usize)
        .map(|_| BURST_AT + within * random.random::<f64>())
        .collect();
    let rate = steady * capacity / MEAN_SESSION;
    let mut at = exponential(random) / rate;
    while at < HORIZON {
        times.push(at);
        at += exponential(random) / rate;
    }
    times.sort_by(f64::total_cmp);
    times
        .into_iter()
        .map(|at| client(scenario, at, random))
        .collect()
}

fn client(scenario: &Scenario, at: f64, random: &mut StdRng) -> Client {
    Client {
        at,
        travel: random.random_range(0.1..1.0),
        comes: random.random::<f64>() >= NO_SHOW,
        weight: random.random_range(0.4..1.6),
        session: MEAN_SESSION
            * match scenario.sessions {
                Sessions::Exponential => exponential(random),
                Sessions::Heavy => bounded_pareto(random),
            },
    }
}

/// Exponential with mean 1.
fn exponential(random: &mut StdRng) -> f64 {
    -(1.0 - random.random::<f64>()).ln()
}

/// Pareto with alpha 1.5, bounded at 100 times the least value, with mean 1.
fn bounded_pareto(random: &mut StdRng) -> f64 {
    let (alpha, span) = (1.5, 100.0_f64);
    let tail = span.powf(-alpha);
    // The mean of one that starts at 1.
    let mean = alpha / (alpha - 1.0) * (1.0 - span.powf(1.0 - alpha)) / (1.0 - tail);
    (1.0 - random.random::<f64>() * (1.0 - tail)).powf(-1.0 / alpha) / mean
}
