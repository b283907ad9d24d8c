//! The policies that are compared: the project's own, and those of others, which see the same reports.

use super::scenario::THRESHOLD;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::time::{Duration, Instant};
use webots_fleet::session::placement::{LoadBalancer, PlacementPolicy};
use webots_fleet::shared::domain::{Instances, Load, ServerReport};

/// What a server reports.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    pub(crate) load: f64,
    pub(crate) present: u32,
    /// Clients of these whose simulation has not started yet.
    pub(crate) starting: u32,
    pub(crate) arrivals: u64,
    pub(crate) failed_starts: u32,
}

/// A policy at work.
pub(crate) trait Dispatcher {
    /// Records a report of a server; `now` is in seconds.
    fn report(&mut self, server: usize, now: f64, seen: Seen);
    /// Chooses a server for a client, or refuses it.
    fn place(&mut self, now: f64) -> Option<usize>;
}

/// The project's own policy: the real code, with simulated time.
pub(crate) struct Own {
    fleet: LoadBalancer<usize>,
    start: Instant,
    /// Whether the servers report their instances, or only their load.
    instances: bool,
    /// Whether it receives the number of failed starts.
    hears_of_failures: bool,
}

impl Own {
    pub(crate) fn new(servers: usize, instances: bool) -> Self {
        let mut fleet = LoadBalancer::new(PlacementPolicy::default());
        (0..servers).for_each(|server| fleet.add(server));
        Self {
            fleet,
            start: Instant::now(),
            instances,
            hears_of_failures: true,
        }
    }

    /// The same without the ejection of servers whose starts fail.
    pub(crate) fn without_ejection(servers: usize) -> Self {
        Self {
            hears_of_failures: false,
            ..Self::new(servers, true)
        }
    }

    /// Chooses among the servers that are eligible.
    pub(crate) fn place_among(&mut self, now: f64, eligible: impl Fn(&usize) -> bool) -> Option<usize> {
        self.fleet.pick(self.at(now), true, eligible)
    }

    fn at(&self, now: f64) -> Instant {
        self.start + Duration::from_secs_f64(now)
    }
}

impl Dispatcher for Own {
    fn report(&mut self, server: usize, now: f64, seen: Seen) {
        let Seen {
            load,
            present,
            starting,
            arrivals,
            failed_starts,
        } = seen;
        let instances = Instances {
            running: present - starting,
            starting,
            slots: 100_000,
            arrivals,
            ..Instances::default()
        };
        let report = ServerReport {
            load: Load::try_from(load).unwrap_or_default(),
            instances: self.instances.then_some(instances),
            failed_starts: if self.hears_of_failures { failed_starts } else { 0 },
            ..ServerReport::default()
        };
        self.fleet.report(&server, self.at(now), &report, true);
    }

    fn place(&mut self, now: f64) -> Option<usize> {
        self.place_among(now, |_| true)
    }
}

/// How a rival chooses among the servers whose last report is under the threshold.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Rule {
    /// The least reported load, the first of equal ones: what the Python original does.
    LeastReported,
    /// Any.
    Random,
    /// The lesser loaded of any two.
    TwoChoices,
    /// Each in turn.
    RoundRobin,
}

/// A policy that decides by the last reports alone.
pub(crate) struct Rival {
    rule: Rule,
    loads: Vec<f64>,
    /// The servers under the threshold.
    open: Vec<usize>,
    last: usize,
    random: StdRng,
}

impl Rival {
    pub(crate) fn new(servers: usize, rule: Rule, seed: u64) -> Self {
        Self {
            rule,
            loads: vec![f64::INFINITY; servers],
            open: Vec::new(),
            last: 0,
            random: StdRng::seed_from_u64(seed),
        }
    }

    fn any(&mut self) -> usize {
        self.open[self.random.random_range(0..self.open.len())]
    }
}

impl Dispatcher for Rival {
    fn report(&mut self, server: usize, _now: f64, seen: Seen) {
        self.loads[server] = seen.load;
        match (self.open.binary_search(&server), seen.load < THRESHOLD) {
            (Ok(at), false) => drop(self.open.remove(at)),
            (Err(at), true) => self.open.insert(at, server),
            _ => {}
        }
    }

    fn place(&mut self, _now: f64) -> Option<usize> {
        if self.open.is_empty() {
            return None;
        }
        Some(match self.rule {
            Rule::LeastReported => *self
                .open
                .iter()
                .min_by(|a, b| self.loads[**a].total_cmp(&self.loads[**b]))?,
            Rule::Random => self.any(),
            Rule::TwoChoices => {
                let one = self.any();
                let other = self.any();
                if self.loads[other] < self.loads[one] {
                    other
                } else {
                    one
                }
            }
            Rule::RoundRobin => {
                let next = self.open.partition_point(|server| *server <= self.last);
                self.last = self.open[next % self.open.len()];
                self.last
            }
        })
    }
}
