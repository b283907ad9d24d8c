//! What is known of one simulation server: its last report, and what has been sent to it since.

use super::allowance::Allowances;
use super::cost::{Common, Cost, Estimate, FULL, believable};
use super::policy::Policy;
use super::unproven::Unproven;
use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::{Duration, Instant};

/// A server's load is the mean of samples over so long: a client that left stays in it that long.
const MEAN_WINDOW: Duration = Duration::from_secs(5);

/// What a simulation server answered when it was asked for its status.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// The mean load of the last five seconds, in percent. A server that reports no finite number from 0 on is taken as lost.
    pub load: f64,
    /// Its simulations; `None` for a server that knows only how to report a load.
    pub instances: Option<Instances>,
}

/// The part of a report that tells of the server's simulations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instances {
    /// The simulations that are there: queued, starting, idle and running.
    pub present: u32,
    /// How many the server can hold.
    pub places: u32,
    /// How many clients have started something since that server began.
    pub arrivals: u64,
    /// Whether the server takes new clients; `false` while it is drained.
    pub accepting: bool,
}

/// A client that was sent to a server.
#[derive(Debug, Clone, Copy)]
struct Placement {
    at: Instant,
    /// Its address, if whether it comes counts for that.
    from: Option<IpAddr>,
}

/// Clients that came (positive) or left (negative) and that the mean load does not fully show yet.
#[derive(Debug, Clone, Copy)]
struct Change {
    at: Instant,
    clients: f64,
}

impl Change {
    /// The clients of this change that a mean load taken at `now` does not show.
    fn unseen(&self, now: Instant, settling: Duration) -> f64 {
        let span = if self.clients > 0.0 { settling } else { MEAN_WINDOW };
        let age = now.saturating_duration_since(self.at);
        if age >= span {
            return 0.0;
        }
        self.clients * (1.0 - age.as_secs_f64() / span.as_secs_f64())
    }
}

/// One server of the fleet.
#[derive(Debug)]
pub(super) struct Server {
    up: bool,
    /// The last good report and when it came; kept while the server is down, to know what is new when it comes back.
    last: Option<(Instant, Report)>,
    /// The placements whose clients have not been seen yet, oldest first.
    in_flight: VecDeque<Placement>,
    settling: VecDeque<Change>,
    unproven: Unproven,
    /// The sum of what `settling` hid from the last report.
    unseen: f64,
    /// How many clients have been sent here in all.
    sent: f64,
    fit: Cost,
    /// What the fleet has been told of that fit.
    estimate: Estimate,
    /// What a client is expected to add to the load, in percent.
    cost: f64,
    /// When this server had its last turn, as a number that grows with each placement of the fleet.
    pub(super) turn: u64,
}

impl Server {
    /// A server that nothing is known of: down until its first report.
    pub(super) fn new(policy: &Policy, turn: u64) -> Self {
        Self {
            up: false,
            last: None,
            in_flight: VecDeque::new(),
            settling: VecDeque::new(),
            unproven: Unproven::default(),
            unseen: 0.0,
            fit: Cost::new(policy.initial_cost),
            cost: believable(policy.initial_cost),
            estimate: Estimate::default(),
            sent: 0.0,
            turn,
        }
    }

    /// Takes in a report that came at `now`; one that is older than the last is passed over.
    pub(super) fn report(
        &mut self,
        now: Instant,
        report: Report,
        policy: &Policy,
        (common, allowances): (&mut Common, &mut Allowances),
    ) {
        if !report.load.is_finite() || report.load < 0.0 {
            self.lose();
            return;
        }
        if self.last.is_some_and(|(at, _)| now < at) {
            return;
        }
        self.forget_missing(now, policy, allowances);
        self.note_changes(now, report.instances, allowances);
        self.settling.retain(|change| change.unseen(now, policy.settling) != 0.0);
        self.unseen = self.settling.iter().map(|change| change.unseen(now, policy.settling)).sum();
        self.learn(now, report, policy, allowances);
        self.last = Some((now, report));
        self.up = true;
        self.share_cost(common, policy);
    }

    /// The server does not answer.
    pub(super) fn lose(&mut self) {
        self.up = false;
        // It is not its clients' fault if they can't come.
        self.in_flight.iter_mut().for_each(|placement| placement.from = None);
        self.unproven.clear();
    }

    /// A client of this address has been sent here, and counts until it comes or is given up.
    pub(super) fn place(&mut self, now: Instant, from: Option<IpAddr>) {
        self.in_flight.push_back(Placement { at: now, from });
        self.sent += 1.0;
    }

    /// The effective load, in percent, if a client can be sent here.
    pub(super) fn effective_load_if_room(&self, now: Instant, policy: &Policy) -> Option<f64> {
        let (_, report) = self.last.filter(|_| self.up)?;
        let in_flight = self.in_flight(now, policy);
        let has_place = report.instances.is_none_or(|instances| {
            let taken = (instances.present as usize).saturating_add(in_flight);
            instances.accepting && taken < instances.places as usize
        });
        let load = self.load_ahead(report.load, in_flight);
        (has_place && load < self.limit(policy)).then_some(load)
    }

    /// The load, in percent, from which on this server takes no client.
    pub(super) fn limit(&self, policy: &Policy) -> f64 {
        // A client that costs much is turned away earlier, because it would take more than the machine has.
        // A threshold that no load reaches says that the load is to close no server.
        if policy.threshold > 100.0 { policy.threshold } else { policy.threshold.min(100.0 - self.cost) }
    }

    /// The last report's load, in percent, if the server is up.
    pub(super) fn load(&self) -> Option<f64> {
        self.last.filter(|_| self.up).map(|(_, report)| report.load)
    }

    /// The load that is to be expected once all that was sent here shows, in percent, if the server is up.
    pub(super) fn effective_load(&self, now: Instant, policy: &Policy) -> Option<f64> {
        self.load().map(|load| self.load_ahead(load, self.in_flight(now, policy)))
    }

    fn load_ahead(&self, load: f64, in_flight: usize) -> f64 {
        // How far a full machine is over is not known, so those who left may not have made it less than full.
        let unseen = if load < FULL { self.unseen } else { self.unseen.max(0.0) };
        #[expect(clippy::cast_precision_loss, reason = "nobody sends 2^52 clients to a server")]
        let ahead = unseen + in_flight as f64;
        (load + self.cost * ahead).max(0.0)
    }

    /// How many placements are on their way: made, their client not seen yet and not given up.
    pub(super) fn in_flight(&self, now: Instant, policy: &Policy) -> usize {
        let missing = |placed: &Placement| now.saturating_duration_since(placed.at) >= policy.patience;
        if self.in_flight.front().is_some_and(missing) {
            self.in_flight.len() - self.in_flight.partition_point(missing)
        } else {
            self.in_flight.len()
        }
    }

    /// When the next placement is given up, if none of their clients comes before.
    pub(super) fn next_expiry(&self, now: Instant, policy: &Policy) -> Option<Instant> {
        let first = self.in_flight.len() - self.in_flight(now, policy);
        self.in_flight.get(first).and_then(|placed| placed.at.checked_add(policy.patience))
    }

    /// What one more client is expected to add to the load, in percent.
    pub(super) fn learned_cost(&self) -> f64 {
        self.cost
    }

    /// What this server says about the cost of a client.
    pub(super) fn estimate(&self) -> Estimate {
        self.estimate
    }

    /// Tells the fleet what has been learned here, and takes over what it makes of that.
    fn share_cost(&mut self, common: &mut Common, policy: &Policy) {
        let estimate = self.fit.estimate(self.cost);
        common.replace(self.estimate, estimate);
        self.estimate = estimate;
        self.cost = common.cost(estimate, policy.initial_cost);
    }

    fn learn(&mut self, now: Instant, report: Report, policy: &Policy, allowances: &mut Allowances) {
        let Some((before, last)) = self.last else {
            return;
        };
        if last.instances.is_some() != report.instances.is_some() {
            // Another program answers there now.
            self.fit = Cost::new(self.cost);
            self.unproven.clear();
        }
        let Some(instances) = report.instances else {
            let told = self.fit.learn_step(now, self.sent - self.unseen, report.load, self.cost);
            self.unproven.judge(now, told, policy, allowances);
            return;
        };
        // Those who wait for a place cost nothing yet.
        let present = f64::from(instances.present.min(instances.places));
        let shown = (present - self.unseen).max(0.0);
        // While many are starting, it is not well known how much of them the load shows.
        let trust = if shown < present { shown / present } else { 1.0 };
        self.fit.learn(shown, report.load, now.saturating_duration_since(before), trust * trust);
    }

    /// Gives up the clients that should have come by now.
    pub(super) fn forget_missing(&mut self, now: Instant, policy: &Policy, allowances: &mut Allowances) {
        let present = self.in_flight(now, policy);
        let missing = self.in_flight.len() - present;
        self.in_flight.drain(..missing).filter_map(|placement| placement.from).for_each(|from| allowances.missed(from));
    }

    /// Compares the report with the one before: who came, who left.
    fn note_changes(&mut self, now: Instant, new: Option<Instances>, allowances: &mut Allowances) {
        let Some(new) = new else {
            // A load alone does not tell who came: every placement is taken to have come as it was made.
            for Placement { at, from } in self.in_flight.drain(..) {
                self.settling.push_back(Change { at, clients: 1.0 });
                if let Some(from) = from {
                    self.unproven.add((at, from));
                }
            }
            return;
        };
        let old = self.last.and_then(|(at, report)| report.instances.map(|old| (at, old)));
        let Some((before, old)) = old.filter(|(_, old)| old.arrivals <= new.arrivals) else {
            // The first report, or a server that began anew: its load has nothing of the past in it. Placements in flight
            // may still come.
            self.settling.clear();
            self.fit.meet(f64::from(new.present));
            return;
        };
        let came = usize::try_from(new.arrivals - old.arrivals).unwrap_or(usize::MAX);
        let came = came.min(self.in_flight.len());
        // The latest placements are taken to be those that came. Nothing tells clients apart; were the oldest taken, then
        // a client that never comes would stay in flight as long as others follow it.
        let first = self.in_flight.len() - came;
        for Placement { at, from } in self.in_flight.drain(first..) {
            self.settling.push_back(Change { at, clients: 1.0 });
            if let Some(from) = from {
                allowances.came(from);
            }
        }
        // Those who left, less those who came without having been sent; some time since the last report.
        let came = f64::from(u32::try_from(came).unwrap_or(u32::MAX));
        let others = f64::from(new.present) - f64::from(old.present) - came;
        self.fit.meet(came + others.max(0.0));
        if others != 0.0 {
            let at = before + now.saturating_duration_since(before) / 2;
            self.settling.push_back(Change { at, clients: others });
        }
    }
}
