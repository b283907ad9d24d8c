//! What is known of one simulation server: its last report, and the clients that were sent to it since then.

use super::cost::{CostFit, Estimate, FULL, FleetCost, believable};
use super::ejection::Ejection;
use super::policy::PlacementPolicy;
use super::replicas::Replicas;
use crate::shared::domain::{Instances, ServerReport};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// A server's load is the mean of its samples over this time: a client that has left stays in it this long.
const MEAN_WINDOW: Duration = Duration::from_secs(5);
/// Time until an arrived client shows fully in the reported load: its simulation takes a while to start, too.
const SETTLING: Duration = Duration::from_secs(8);

/// The part of a report that placement uses.
#[derive(Debug, Clone, Copy)]
struct LastReport {
    at: Instant,
    /// The mean load of the last five seconds, in percent.
    load: f64,
    /// `None` if the server reports only a load.
    instances: Option<Instances>,
}

/// A client that was sent to a server and has not been seen there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placement {
    at: Instant,
    /// Whether it reserves room, see [`super::LoadBalancer::pick`].
    takes_room: bool,
}

/// Clients that arrived (positive) or left (negative) and that the mean load does not fully show yet.
#[derive(Debug, Clone, Copy)]
struct ClientDelta {
    at: Instant,
    clients: f64,
}

impl ClientDelta {
    /// The clients of this change that a mean load taken at `now` does not show.
    fn unseen(&self, now: Instant) -> f64 {
        let span = if self.clients > 0.0 { SETTLING } else { MEAN_WINDOW };
        let age = now.saturating_duration_since(self.at);
        self.clients * (1.0 - age.as_secs_f64() / span.as_secs_f64()).max(0.0)
    }
}

/// Sort key of a server: those to which others are preferred, because they are ejected, come last; then the lowest load
/// comes first, and of equal loads the server that was chosen longest ago.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Rank {
    pub(super) comes_last: bool,
    /// The bits of the load, which sort as the load does: it is not negative.
    load: u64,
    /// Unique in a fleet.
    last_pick: u64,
}

impl Rank {
    /// The load with all clients that were sent to the server, in percent.
    pub(super) fn load(self) -> f64 {
        f64::from_bits(self.load)
    }
}

/// One server of the fleet.
#[derive(Debug, Default)]
pub(super) struct Backend {
    /// Whether it answers.
    pub(super) up: bool,
    /// Whether it takes new clients; `false` while it is drained.
    accepting: bool,
    /// Whether it has no free slot, as it has said since its last report.
    pub(super) is_filled: bool,
    /// The last report; kept while the server is down, to know what is new when it comes back.
    last: Option<LastReport>,
    /// The placements whose clients have neither been seen nor given up, oldest first.
    pub(super) in_flight: VecDeque<Placement>,
    /// Number of them that reserve room.
    reserved: usize,
    /// Number of those that reserve room and were placed since the last report.
    fresh: usize,
    /// Number of clients that arrive per placement made here, including those of other session servers.
    clients_per_placement: f64,
    settling: VecDeque<ClientDelta>,
    /// Number of clients in `settling` that the last report's load does not show.
    unseen: f64,
    fit: CostFit,
    /// The estimate from `fit` that is part of the fleet's sums.
    pub(super) estimate: Estimate,
    /// What a client is expected to add to the load, in percent.
    pub(super) cost: f64,
    /// When this server was chosen last, as a number that grows with each placement of the fleet.
    pub(super) last_pick: u64,
    /// Whether its starts fail.
    pub(super) ejection: Ejection,
    /// Its rank in the fleet, `None` if it has no room.
    pub(super) rank: Option<Rank>,
}

impl Backend {
    /// A server without reports: down until its first one.
    pub(super) fn new(policy: &PlacementPolicy, last_pick: u64) -> Self {
        Self {
            clients_per_placement: 1.0,
            fit: CostFit::new(policy.client_cost),
            cost: believable(policy.client_cost),
            last_pick,
            ..Self::default()
        }
    }

    /// Records a report that arrived at `now`, not before the last one.
    pub(super) fn report(
        &mut self,
        now: Instant,
        report: &ServerReport,
        accepting: bool,
        policy: &PlacementPolicy,
        fleet: &mut FleetCost,
        replicas: &mut Replicas,
    ) {
        self.ejection.report(now, report.failed_starts);
        let report = LastReport {
            at: now,
            load: report.load.percent(),
            instances: report.instances,
        };
        self.note_changes(report, replicas);
        self.fresh = 0;
        self.is_filled = false;
        // Changes that the load shows by now are dropped.
        self.settling.retain(|change| change.unseen(now) != 0.0);
        self.unseen = self.settling.iter().map(|change| change.unseen(now)).sum();
        self.learn(report);
        self.last = Some(report);
        self.up = true;
        self.accepting = accepting;
        // A report of only a load teaches nothing, because it does not show which part of the load is clients: such a
        // server keeps the configured cost.
        let counts = report.instances.is_some();
        let estimate = if counts {
            self.fit.estimate(self.cost)
        } else {
            Estimate::default()
        };
        fleet.replace(self.estimate, estimate);
        self.estimate = estimate;
        self.cost = if counts {
            fleet.cost(estimate, policy.client_cost)
        } else {
            believable(policy.client_cost)
        };
    }

    /// Records that a client was sent here.
    pub(super) fn add_placement(&mut self, now: Instant, takes_room: bool) {
        self.in_flight.push_back(Placement { at: now, takes_room });
        self.reserved += usize::from(takes_room);
        self.fresh += usize::from(takes_room);
    }

    /// Takes back the last client that was sent here.
    pub(super) fn withdraw_placement(&mut self) {
        if self.in_flight.pop_back().is_some_and(|placed| placed.takes_room) {
            self.reserved = self.reserved.saturating_sub(1);
            self.fresh = self.fresh.saturating_sub(1);
        }
    }

    /// Ends an ejection, and gives up overdue clients. Returns the number of those that reserved room.
    pub(super) fn expire(&mut self, now: Instant, policy: &PlacementPolicy) -> usize {
        self.ejection.expire(now);
        let is_late = |placed: &Placement| now.saturating_duration_since(placed.at) >= policy.placement_timeout;
        let late = self.in_flight.partition_point(is_late);
        let given_up = self.in_flight.drain(..late).filter(|placed| placed.takes_room).count();
        self.reserved -= given_up;
        given_up
    }

    /// Whether a client can be sent here.
    fn has_room(&self, policy: &PlacementPolicy) -> bool {
        let has_slot = |instances: Instances| {
            // The slots that the server has reserved are for clients in flight, from here or elsewhere.
            let on_their_way = count(self.reserved).max(f64::from(instances.reserved));
            let taken = f64::from(instances.present()) + on_their_way + self.sent_by_others();
            taken < f64::from(instances.slots)
        };
        self.would_take(policy)
            && !self.is_filled
            && self.last.is_some_and(|report| report.instances.is_none_or(has_slot))
    }

    /// Whether a client can be sent here as soon as there is a free slot.
    pub(super) fn would_take(&self, policy: &PlacementPolicy) -> bool {
        self.accepting && self.effective_load().is_some_and(|load| load < self.limit(policy))
    }

    /// The load, in percent, from which this server gets no clients.
    pub(super) fn limit(&self, policy: &PlacementPolicy) -> f64 {
        // A server with expensive clients is full earlier, because the next one would need more than the machine has.
        // A threshold above 100 means that the load never makes a server full.
        if policy.threshold > 100.0 {
            policy.threshold
        } else {
            policy.threshold.min(100.0 - self.cost)
        }
    }

    /// The load, in percent, that is expected once it shows all clients that reserve room; `None` if the server is
    /// down.
    pub(super) fn effective_load(&self) -> Option<f64> {
        self.load_with(self.reserved)
    }

    /// The rank that the server should have; `None` if it has no room. Servers are compared by their load with all
    /// clients that were sent to them.
    pub(super) fn current_rank(&self, policy: &PlacementPolicy) -> Option<Rank> {
        let load = self.load_with(self.in_flight.len()).filter(|_| self.has_room(policy))?;
        Some(Rank {
            comes_last: self.comes_last(),
            load: load.to_bits(),
            last_pick: self.last_pick,
        })
    }

    /// Whether others are preferred, because starts fail here.
    pub(super) fn comes_last(&self) -> bool {
        let starts = |instances: Instances| instances.starting > 0 || instances.queued > 0;
        let is_starting = self.last.and_then(|report| report.instances).is_some_and(starts);
        self.ejection.comes_last(is_starting || !self.in_flight.is_empty())
    }

    fn load_with(&self, in_flight: usize) -> Option<f64> {
        let LastReport { load, .. } = self.last.filter(|_| self.up)?;
        // The overload of a full machine is unknown, so it may still be full after clients have left.
        let unseen = if load < FULL { self.unseen } else { self.unseen.max(0.0) };
        let ahead = unseen + count(in_flight) + self.sent_by_others();
        Some((load + self.cost * ahead).max(0.0))
    }

    /// Estimated number of clients that other session servers have sent here since the last report.
    fn sent_by_others(&self) -> f64 {
        count(self.fresh.min(self.reserved)) * (self.clients_per_placement - 1.0)
    }

    fn learn(&mut self, report: LastReport) {
        let Some((before, instances)) = self.last.zip(report.instances) else {
            return;
        };
        // Clients in the queue cost nothing yet.
        let present = f64::from(instances.present() - instances.queued);
        let shown = (present - self.unseen).max(0.0);
        // While many start, it is uncertain how much of them the load shows.
        let trust = if shown < present { shown / present } else { 1.0 };
        self.fit.learn(
            shown,
            report.load,
            report.at.saturating_duration_since(before.at),
            trust * trust,
        );
    }

    /// Compares the report with the one before: which clients arrived, which left.
    fn note_changes(&mut self, report: LastReport, replicas: &mut Replicas) {
        let Some(new) = report.instances else {
            // A load alone does not show arrivals: every placement that reserves room is assumed to have arrived at
            // once.
            let arrived = self.in_flight.drain(..).filter(|placed| placed.takes_room);
            self.settling
                .extend(arrived.map(|Placement { at, .. }| ClientDelta { at, clients: 1.0 }));
            self.reserved = 0;
            return;
        };
        let old = self.last.and_then(|last| Some((last.at, last.instances?)));
        let Some((before, old)) = old.filter(|(_, old)| old.arrivals <= new.arrivals) else {
            // The first report, or a restarted server: its load contains nothing of the past. Placements in flight may
            // still arrive.
            self.settling.clear();
            self.fit.count_arrivals(f64::from(new.present()));
            return;
        };
        let arrivals = usize::try_from(new.arrivals - old.arrivals).unwrap_or(usize::MAX);
        let came = arrivals.min(self.in_flight.len());
        replicas.count(count(arrivals), count(came));
        self.clients_per_placement = replicas.clients_per_placement();
        // Reports do not identify clients, so arrivals are matched to the most recent placements. If the oldest were
        // taken, a client that never arrives would stay in flight as long as others follow it.
        for Placement { at, takes_room } in self.in_flight.drain(self.in_flight.len() - came..) {
            self.settling.push_back(ClientDelta { at, clients: 1.0 });
            self.reserved -= usize::from(takes_room);
        }
        // Other changes: clients that arrived without a placement from here, minus those that left. When they happened
        // is unknown: half-way between the reports is assumed.
        let came = count(came);
        let others = f64::from(new.present()) - f64::from(old.present()) - came;
        self.fit.count_arrivals(came + others.max(0.0));
        if others != 0.0 {
            let at = before + report.at.saturating_duration_since(before) / 2;
            self.settling.push_back(ClientDelta { at, clients: others });
        }
    }
}

/// A number of clients, to calculate with.
#[expect(clippy::cast_precision_loss, reason = "there are no 2^52 clients")]
pub(super) fn count(clients: usize) -> f64 {
    clients as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::Load;

    /// One server, the start of its clock, and what its fleet has learned of costs and of other session servers.
    struct Server(Backend, Instant, FleetCost, Replicas);

    impl Server {
        fn new(load: f64, counts: Option<(u32, u64)>) -> Self {
            let mut server = Self(
                Backend::new(&PlacementPolicy::default(), 0),
                Instant::now(),
                FleetCost::default(),
                Replicas::default(),
            );
            server.report(0.0, load, counts);
            server
        }

        fn at(&self, seconds: f64) -> Instant {
            self.1 + Duration::from_secs_f64(seconds)
        }

        fn place(&mut self, seconds: f64) {
            self.0.add_placement(self.at(seconds), true);
        }

        /// Reports a load and the numbers of clients that are present and that have arrived.
        fn report(&mut self, seconds: f64, load: f64, counts: Option<(u32, u64)>) {
            let instances = counts.map(|(running, arrivals)| Instances {
                running,
                slots: 1000,
                arrivals,
                ..Instances::default()
            });
            let report = ServerReport {
                instances,
                ..ServerReport::load_only(Load::try_from(load).unwrap())
            };
            let at = self.at(seconds);
            let policy = PlacementPolicy::default();
            self.0.expire(at, &policy);
            self.0.report(at, &report, true, &policy, &mut self.2, &mut self.3);
        }

        fn assert_load(&self, expected: f64, tolerance: f64) {
            let load = self.0.effective_load().unwrap();
            assert!((load - expected).abs() <= tolerance, "{load} is not {expected}");
        }
    }

    #[test]
    fn a_client_that_came_counts_until_the_load_shows_it() {
        let mut server = Server::new(10.0, Some((5, 5)));
        server.place(0.0);
        server.assert_load(12.0, 0.0);
        for (after, load, expected) in [(1.0, 10.0, 11.75), (4.0, 11.0, 12.0), (8.0, 12.0, 12.0)] {
            server.report(after, load, Some((6, 6)));
            assert_eq!(server.0.in_flight.len(), 0);
            server.assert_load(expected, 0.3);
        }
    }

    #[test]
    fn a_load_alone_teaches_no_cost() {
        let mut server = Server::new(10.0, None);
        server.place(0.0);
        for (after, expected) in [(0.0, 12.0), (4.0, 11.0), (8.0, 10.0)] {
            server.report(after, 10.0, None);
            server.assert_load(expected, 0.1);
        }
        for second in 9..300 {
            server.place(f64::from(second));
            server.report(f64::from(second), f64::from(second % 90), None);
            assert_eq!(server.0.cost.to_bits(), 2.0_f64.to_bits());
        }
    }

    #[test]
    fn a_client_that_never_comes_does_not_live_on_those_who_follow() {
        let mut server = Server::new(10.0, Some((0, 0)));
        server.place(0.0);
        for second in 1..=20 {
            server.place(f64::from(second) - 0.5);
            server.report(second.into(), 10.0, Some((second, second.into())));
        }
        assert_eq!(server.0.in_flight.len(), 0);
    }

    #[test]
    fn those_who_left_are_taken_off_the_load_that_still_shows_them() {
        let mut server = Server::new(40.0, Some((20, 20)));
        server.report(1.0, 40.0, Some((10, 20)));
        server.assert_load(22.0, 1.0);
        server.report(8.0, 21.0, Some((10, 20)));
        server.assert_load(21.0, 0.0);
    }

    #[test]
    fn a_server_that_was_started_again_keeps_what_is_on_its_way() {
        let mut server = Server::new(60.0, Some((30, 500)));
        server.place(0.0);
        server.0.up = false;
        server.report(3.0, 1.0, Some((0, 0)));
        assert_eq!(server.0.in_flight.len(), 1);
        server.assert_load(3.0, 0.1);
        server.report(4.0, 1.0, Some((1, 1)));
        assert_eq!(server.0.in_flight.len(), 0);
    }
}
